"""A rig without threads or sensors: three cameras and a LiDAR whose checks and windows say what a test says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.adapters.files.scribe import Scribe
from coec.calibration.lifecycle import PairState, initial_state
from coec.calibration.rig.evidence import Look
from coec.calibration.rig.vehicle import Served, Windowed
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.config import PairConfig
from coec.geometry import se3
from coec.runtime.rig.keeper import RigKeeper, RigKnown
from coec.runtime.rig.pair_side import PairOfRig
from pair_bench import RIG, configuration
from rigs import BIAS, NS, PLACE, POSES, SIGMA

CAMERAS = ("front", "left", "rear")
Poses = Mapping[str, Matrix4]


def pair_config(name: str) -> PairConfig:
    """A pair of a camera and the LiDAR `roof`."""
    pair = configuration(Path("state")).pairs[0]
    camera = pair.camera.model_copy(update={"name": name, "key": f"in/{name}"})
    lidar = pair.lidar.model_copy(update={"name": "roof", "key": "in/roof"})
    return pair.model_copy(update={"name": f"{name}-roof", "camera": camera, "lidar": lidar})


def pose(camera: str, poses: Poses) -> Matrix4:
    """(4, 4) of a camera and the LiDAR."""
    return np.asarray(poses[camera] @ se3.inverse(poses["roof"]))


def state(camera: str, poses: Poses = POSES) -> PairState:
    """A pair that serves its nominal calibration."""
    return replace(initial_state(RIG), T_camera_lidar=pose(camera, poses))


def look(camera: str, poses: Poses, at_s: float, error: NDArray[np.float64]) -> Look:
    """A check that puts a pair where these poses have it, but for an error (6,)."""
    T_a_b = se3.perturb(pose(camera, poses), error)
    return Look(f"{camera}-roof", round(at_s * NS), T_a_b, np.diag(1.0 / SIGMA**2), PLACE, BIAS)


def window(camera: str, poses: Poses, start_s: float) -> Windowed:
    """A window of ten seconds without an error."""
    stamp_ns = round((start_s + 10.0) * NS)
    measurement = Measurement(pose(camera, poses), Uncertainty.independent(SIGMA), stamp_ns)
    return Windowed(measurement, round(start_s * NS))


def serves(camera: str, poses: Poses, start_s: float) -> Served:
    """What a pair serves by frames since then."""
    return Served(pose(camera, poses), SIGMA, round(start_s * NS))


class SaidRig:
    """The rig's thread, done by the test.

    Attributes:
        pairs: by camera.
        told: what was told, in order.
    """

    def __init__(self, folder: Path, cameras: tuple[str, ...] = CAMERAS, poses: Poses = POSES) -> None:
        self.scribe = Scribe(folder)
        self.keeper = RigKeeper(folder, (), self.scribe)
        self.told: list[RigKnown] = []
        self.pairs: dict[str, PairOfRig] = {}
        for camera in cameras:
            known = state(camera, poses)
            self.pairs[camera] = self.keeper.join(pair_config(camera), pose(camera, POSES), known, lambda: True)
        self.keeper.listen(self.told.append, lambda: None)
        self.settle()

    def settle(self) -> None:
        """What the thread does until there is nothing to be done."""
        while self.keeper.work(0.0):
            pass

    def put(self, camera: str, due_s: float, said: Look | Windowed | Served) -> None:
        """A pair says something."""
        self.keeper.put(f"{camera}-roof", round(due_s * NS), said)

    def at(self, camera: str, at_s: float, *, waits: bool = False) -> bool:
        """A pair has frames of this time; whether it has to wait for the rig."""
        return self.pairs[camera].must_wait(round(at_s * NS), for_own=waits)

    @property
    def known(self) -> RigKnown:
        """What was told last."""
        return self.told[-1]
