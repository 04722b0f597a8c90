"""Small rigs for tests, and what looks of them say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.attribution import RigState, after_edge_observation, initial
from coec.calibration.rig.evidence import EdgeObservation
from coec.calibration.rig.types import Edge, RigGraph, RigidLink, Sensor, SensorKind
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.geometry import se3

SIGMA = np.array([radians(0.06)] * 3 + [0.015] * 3)
PLACE = np.array([radians(0.04)] * 3 + [0.01] * 3)
BIAS = np.array([radians(0.12)] * 3 + [0.03] * 3)
TURN = np.array([0.0, radians(1.0), 0.0, 0.0, 0.0, 0.0])
NS = 1_000_000_000

POSES: Mapping[str, Matrix4] = {
    "front": se3.exp(np.array([1.2, -1.2, 1.2, 0.1, -0.8, 3.0])),
    "left": se3.exp(np.array([1.5, 0.1, 0.2, 0.5, 1.0, -1.0])),
    "rear": se3.exp(np.array([1.2, 1.2, -1.2, -0.4, 0.9, 1.0])),
    "roof": se3.exp(np.array([0.0, 0.02, 0.1, -1.2, 0.0, -1.9])),
    "bumper": se3.exp(np.array([0.0, 0.02, 1.0, -3.2, 0.9, -0.6])),
}
"""T_sensor_rig (4, 4); what is called after a mount is a LiDAR."""


def graph(
    pairs: Sequence[tuple[str, str]], links: Sequence[RigidLink] = (), poses: Mapping[str, Matrix4] = POSES
) -> RigGraph:
    """The sensors of some pairs, each (camera, LiDAR) or two of a kind."""
    names = dict.fromkeys(name for pair in pairs for name in pair)
    sensors = [Sensor(name, SensorKind.LIDAR if name in ("roof", "bumper") else SensorKind.CAMERA) for name in names]
    return RigGraph.of(sensors, [Edge(f"{a}-{b}", a, b, poses[a] @ se3.inverse(poses[b])) for a, b in pairs], links)


def edge_check(edge: Edge, poses: Mapping[str, Matrix4], at_s: float, error: NDArray[np.float64]) -> EdgeObservation:
    """One that puts an edge where these poses have it, but for an error (6,); a pair that was moved suspects so."""
    right = poses[edge.a] @ se3.inverse(poses[edge.b])
    stamp_ns, moved = round(at_s * NS), bool(np.abs(se3.difference(right, edge.T_a_b)).max() > 1e-6)
    information = np.diag(1.0 / SIGMA**2)
    return EdgeObservation(
        edge.name, stamp_ns, se3.perturb(right, error), information, PLACE, BIAS, stepped_ns=stamp_ns if moved else None
    )


def checked_rig(
    rig: RigGraph,
    before: Mapping[str, Matrix4],
    after: Mapping[str, Matrix4],
    rounds: tuple[int, int] = (7, 5),
    seed: int = 1,
) -> RigState:
    """Rounds of looks at every edge, 5 s apart, before and after something happened."""
    rng, state = np.random.default_rng(seed), initial(rig)
    for turn in range(sum(rounds)):
        for place, edge in enumerate(rig.edges):
            poses = before if turn < rounds[0] else after
            state = after_edge_observation(
                state, rig, edge_check(edge, poses, 5.0 * turn + 0.5 * place, SIGMA * rng.normal(size=6))
            )
    return state


def moved_poses(*names: str, xi: NDArray[np.float64] = TURN) -> dict[str, Matrix4]:
    """The poses after some sensors moved by ξ about their own axes."""
    return {name: se3.perturb(pose, xi) if name in names else pose for name, pose in POSES.items()}


def edge_windows(
    rig: RigGraph, poses: Mapping[str, Matrix4], seed: int, sigma: NDArray[np.float64] = SIGMA
) -> dict[str, Measurement]:
    """One of each edge, off by so much."""
    rng = np.random.default_rng(seed)
    return {
        edge.name: Measurement(
            se3.perturb(poses[edge.a] @ se3.inverse(poses[edge.b]), sigma * rng.normal(size=6)),
            Uncertainty.independent(sigma),
            NS,
        )
        for edge in rig.edges
    }
