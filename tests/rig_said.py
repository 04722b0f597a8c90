"""A rig without threads or sensors: three cameras and a LiDAR whose checks and windows say what a test says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.adapters.files.scribe import DiskWriter
from coec.calibration.lifecycle import PairState, initial_state
from coec.calibration.rig.evidence import EdgeObservation
from coec.calibration.rig.vehicle import EdgeWindow, ServedEdge
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.config import PairConfig
from coec.geometry import se3
from coec.runtime.rig.keeper import RigEstimatorThread, RigSnapshot
from coec.runtime.rig.pair_side import RigMember
from pair_bench import PAIR_RIG, pair_configuration
from rigs import BIAS, NS, PLACE, POSES, SIGMA

CAMERAS = ("front", "left", "rear")
CameraPoses = Mapping[str, Matrix4]


def pair_config(name: str) -> PairConfig:
    """A pair of a camera and the LiDAR `roof`."""
    pair = pair_configuration(Path("state")).pairs[0]
    camera = pair.camera.model_copy(update={"name": name, "key": f"in/{name}"})
    lidar = pair.lidar.model_copy(update={"name": "roof", "key": "in/roof"})
    return pair.model_copy(update={"name": f"{name}-roof", "camera": camera, "lidar": lidar})


def pair_pose(camera: str, poses: CameraPoses) -> Matrix4:
    """(4, 4) of a camera and the LiDAR."""
    return np.asarray(poses[camera] @ se3.inverse(poses["roof"]))


def pair_state(camera: str, poses: CameraPoses = POSES) -> PairState:
    """A pair that serves its nominal calibration."""
    return replace(initial_state(PAIR_RIG), T_camera_lidar=pair_pose(camera, poses))


def pair_check(camera: str, poses: CameraPoses, at_s: float, error: NDArray[np.float64]) -> EdgeObservation:
    """A check that puts a pair where these poses have it, but for an error (6,)."""
    T_a_b = se3.perturb(pair_pose(camera, poses), error)
    return EdgeObservation(f"{camera}-roof", round(at_s * NS), T_a_b, np.diag(1.0 / SIGMA**2), PLACE, BIAS)


def pair_window(camera: str, poses: CameraPoses, start_s: float) -> EdgeWindow:
    """A window of ten seconds without an error."""
    stamp_ns = round((start_s + 10.0) * NS)
    measurement = Measurement(pair_pose(camera, poses), Uncertainty.independent(SIGMA), stamp_ns)
    return EdgeWindow(measurement, round(start_s * NS))


def served_extrinsic(camera: str, poses: CameraPoses, start_s: float) -> ServedEdge:
    """What a pair serves by frames since then."""
    return ServedEdge(pair_pose(camera, poses), SIGMA, round(start_s * NS))


class RigEstimatorBench:
    """The rig's thread, done by the test.

    Attributes:
        pairs: by camera.
        told: what was told, in order.
    """

    def __init__(self, folder: Path, cameras: tuple[str, ...] = CAMERAS, poses: CameraPoses = POSES) -> None:
        self.disk_writer = DiskWriter(folder)
        self.estimator = RigEstimatorThread(folder, (), self.disk_writer)
        self.states: list[RigSnapshot] = []
        self.pairs: dict[str, RigMember] = {}
        for camera in cameras:
            known = pair_state(camera, poses)
            self.pairs[camera] = self.estimator.join(pair_config(camera), pair_pose(camera, POSES), known, lambda: True)
        self.estimator.connect(self.states.append, lambda: None)
        self.settle()

    def settle(self) -> None:
        """What the thread does until there is nothing to be done."""
        while self.estimator.work(0.0):
            pass

    def put(self, camera: str, due_s: float, report: EdgeObservation | EdgeWindow | ServedEdge) -> None:
        """A pair says something."""
        self.estimator.put(f"{camera}-roof", round(due_s * NS), report)

    def must_wait(self, camera: str, at_s: float, *, waits: bool = False) -> bool:
        """A pair has frames of this time; whether it has to wait for the rig."""
        return self.pairs[camera].must_wait(round(at_s * NS), for_own=waits)

    @property
    def known(self) -> RigSnapshot:
        """What was told last."""
        return self.states[-1]
