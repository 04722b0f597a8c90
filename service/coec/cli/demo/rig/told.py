"""The last hop of the demonstration of a rig: frames in, what is believed of every sensor out.

`Beholder` does what the service does, in this process: looks pair by pair, each look evidence of its edge, and all of
them attributed. Whoever asks a running service instead has the same method.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from math import degrees, sqrt
from typing import Protocol

import numpy as np

from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensors import prepare_sweep
from coec.calibration.rig.attribution import SensorState, after_look, begun, sensors
from coec.calibration.rig.evidence import of_check
from coec.calibration.types import LidarFrame
from coec.cli.demo.rig.vehicle import Frames
from coec.evaluation.check_drives import CHECK_PAIRS
from coec.evaluation.rig_looks import SeenPair, due, graph_of, look_at
from coec.reports.rig_plot import MOVED, EdgeSeen
from coec.simulation.rig_drive import RigDrive
from coec.simulation.rig_instants import pair_of


@dataclass(frozen=True, slots=True)
class SensorTold:
    """What is believed of a sensor, see `SensorState`; `moved_deg` is None where it did not move."""

    name: str
    kind: str
    state: str
    probability: float
    moved_deg: float | None
    reason: str


@dataclass(frozen=True, slots=True)
class Told:
    """After a look at a pair.

    Attributes:
        second: of the drive, of the last frame that was looked at.
        looked_at: the pair.
        sensors: by name.
        edges: what the latest look at each pair says, by pair; pairs that were never looked at are not there.
    """

    second: float
    looked_at: str
    sensors: Mapping[str, SensorTold]
    edges: Mapping[str, EdgeSeen]

    @property
    def named(self) -> frozenset[str]:
        """Sensors that are said to have moved."""
        return frozenset(name for name, sensor in self.sensors.items() if sensor.state in MOVED)


class Teller(Protocol):
    """Who is shown the frames and tells."""

    def hear(self, frames: Frames) -> list[Told]:
        """After frames of one more instant: something new for each look that was taken, in order."""
        ...


class Beholder:
    """Looks for itself: nothing is known of the rig but where it was built."""

    def __init__(self, drive: RigDrive, lidar: str) -> None:
        self._rigs = {camera: drive.pair(camera, lidar).rig for camera in drive.cameras}
        self._graph = graph_of(drive, lidar)
        self._state = begun(self._graph)
        self._seen: dict[str, deque[SeenPair]] = {camera: deque(maxlen=CHECK_PAIRS) for camera in drive.cameras}
        self._edges: dict[str, EdgeSeen] = {}
        self._instants = 0

    def hear(self, frames: Frames) -> list[Told]:
        """See `Teller`.

        Raises:
            CalibrationError: a picture cannot be decoded.
        """
        sweep = frames.sweep
        assert isinstance(sweep, LidarFrame)
        ready = prepare_sweep(sweep)
        for camera, picture in frames.pictures.items():
            pair = pair_of(picture, sweep, frames.motions)
            if pair is not None:
                self._seen[camera].append(SeenPair(pair, ready))
        self._instants += 1
        return [self._look(frames, camera) for camera in due(self._instants, tuple(self._rigs))]

    def _look(self, frames: Frames, camera: str) -> Told:
        rig = self._rigs[camera]
        pose = rig.T_camera_lidar_nominal
        told = look_at(rig, pose, self._seen[camera])
        evidence = of_check(rig.pair, pose, told)
        if evidence is not None:
            self._state = after_look(self._state, self._graph, evidence)
            self._edges[rig.pair] = _edge(camera, rig.lidar_frame, told)
        believed = {one.name: _sensor(one) for one in sensors(self._state, self._graph)}
        return Told(frames.second, rig.pair, believed, dict(self._edges))


def _sensor(of: SensorState) -> SensorTold:
    moved_deg = None if of.moved is None else degrees(float(np.linalg.norm(of.moved.x[:3])))
    return SensorTold(of.name, of.kind.value, of.health.value, of.probability, moved_deg, of.reasons[0].text)


def _edge(camera: str, lidar: str, told: Observation) -> EdgeSeen:
    """By how much the pair is turned; its σ such that the turn has as many of it as all three axes together."""
    turn = told.offset[:3]
    turn_rad, sigmas = float(np.linalg.norm(turn)), sqrt(float(np.sum((turn / told.sigma[:3]) ** 2)))
    return EdgeSeen(camera, lidar, degrees(turn_rad), degrees(turn_rad / sigmas) if sigmas > 0.0 else float("nan"))
