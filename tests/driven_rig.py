"""A rig as it is driven, without pairs, threads or sensors: its looks and windows say what a test says."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig import lidar_looks, vehicle
from coec.calibration.rig.attribution import SensorHealth
from coec.calibration.rig.types import Edge, RigGraph
from coec.calibration.rig.vehicle import EdgeWindow, ServedEdge, VehicleRig
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.geometry import se3
from rigs import NS, POSES, SIGMA, edge_check

LIDAR_CHECK_SIGMA = np.array([*np.radians([0.04, 0.02, 0.02]), 0.009, 0.004, 0.005])
"""(6,) what a look at two LiDARs claims (rad, m)."""

STAR = (("front", "roof"), ("left", "roof"), ("rear", "roof"))
LOOPS = (*STAR, ("front", "bumper"), ("left", "bumper"))
RigPoses = Mapping[str, Matrix4]


def pose_of(edge: Edge, poses: RigPoses) -> Matrix4:
    """(4, 4) where these poses have an edge."""
    return np.asarray(poses[edge.a] @ se3.inverse(poses[edge.b]))


def windowed_measurement(edge: Edge, poses: RigPoses, start_s: float, error: NDArray[np.float64]) -> EdgeWindow:
    """A window of ten seconds that puts an edge where these poses have it, but for an error (6,)."""
    pose = se3.perturb(pose_of(edge, poses), error)
    stamp_ns = round((start_s + 10.0) * NS)
    return EdgeWindow(Measurement(pose, Uncertainty.independent(SIGMA), stamp_ns), round(start_s * NS))


def known_of(edge: Edge, poses: RigPoses, at_s: float) -> Measurement:
    """What many windows up to a time say of the mount."""
    return Measurement(pose_of(edge, poses), Uncertainty.independent(0.2 * SIGMA), round(at_s * NS))


class RigDrive:
    """A rig as it is driven: looks of all pairs every 5 s, windows that pairs serve at once, and looks at LiDARs."""

    def __init__(self, rig: RigGraph, seed: int = 1) -> None:
        self.rng = np.random.default_rng(seed)
        self.at_s = 0.0
        serves = {
            edge.name: ServedEdge(pose_of(edge, POSES), SIGMA, 0, known_of(edge, POSES, -5.0)) for edge in rig.edges
        }
        windows = {edge.name: windowed_measurement(edge, POSES, -30.0, self._error()) for edge in rig.edges}
        self.state: VehicleRig = vehicle.initial_rig(rig, serves, windows)

    def _error(self) -> NDArray[np.float64]:
        return np.asarray(SIGMA * self.rng.normal(size=6))

    def add_checks(self, poses: RigPoses, rounds: int, blind: tuple[str, ...] = ()) -> None:
        for _ in range(rounds):
            for index, edge in enumerate(self.state.graph.edges):
                if edge.name not in (*blind, *self.state.graph.of_lidars):
                    seen = edge_check(edge, poses, self.at_s + 0.5 * index, self._error())
                    self.state = vehicle.after_edge_observation(self.state, seen)
            self.at_s += 5.0

    def add_window(self, name: str, poses: RigPoses, start_s: float, *, serves: bool = True) -> Matrix4:
        window = windowed_measurement(self.state.graph.edge[name], poses, start_s, self._error())
        stamp_ns = round(self.at_s * NS)
        self.state = vehicle.after_window(self.state, name, window, stamp_ns)
        pose = window.measurement.T_camera_lidar
        if serves:
            self.state = vehicle.after_served(self.state, name, ServedEdge(pose, SIGMA, window.start_ns), stamp_ns)
        return pose

    def health(self) -> dict[str, SensorHealth]:
        return {sensor.name: sensor.health for sensor in self.state.sensors}

    def add_lidar_check(self, name: str, poses: RigPoses, error: NDArray[np.float64] | None = None) -> None:
        """A look at two LiDARs that were there two seconds ago, off by an error (6,) beside what it claims."""
        edge = self.state.graph.edge[name]
        off = LIDAR_CHECK_SIGMA * self.rng.normal(size=6) + (0.0 if error is None else error)
        T_a_b, stamp_ns = se3.perturb(pose_of(edge, poses), off), round(self.at_s * NS)
        seen = lidar_looks.observation_of_registration(name, stamp_ns, T_a_b, np.diag(LIDAR_CHECK_SIGMA**2))
        window = EdgeWindow(lidar_looks.window_of(stamp_ns, T_a_b, np.diag(LIDAR_CHECK_SIGMA**2)), stamp_ns - 2 * NS)
        self.state = vehicle.after_lidars(self.state, seen, window)
