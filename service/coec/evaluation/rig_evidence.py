"""Drawn evidence of a rig: what checks and windows of its pairs say, wrong in all the ways that real ones are.

Each pair has an estimator of its own, biased, and more so in one pair than in the others; streets displace it, together
for as long as the street lasts; single checks scatter with longer tails than the attribution believes in, are bad in
runs, faint, late, or missing for a whole drive. Sizes are those of `commissioning.baseline`, which were measured on the
recordings; the shares are worse than what was seen on simulated drives (`monitor.likelihood`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.baseline import (
    FLOOR,
    PRIOR_SPREAD_POSE,
    PRIOR_SPREAD_ROTATION,
    STREET,
    UNCOMMISSIONED_BIAS,
)
from coec.calibration.monitor.likelihood import WEAK_TIMES
from coec.calibration.rig.evidence import Look, information_of
from coec.calibration.rig.steps import REACH
from coec.calibration.rig.types import Edge, Kind, RigGraph, Sensor
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.evaluation.check_drives import CHECK_PAIRS
from coec.geometry import se3
from coec.geometry.vectors import random_direction

Array = NDArray[np.float64]
Poses = Mapping[str, Matrix4]
"""T_sensor_rig (4, 4), by name."""

NS_PER_S = 1_000_000_000

CHECK = np.sqrt(np.concatenate([PRIOR_SPREAD_ROTATION[:3], PRIOR_SPREAD_POSE[3:]]) ** 2 / CHECK_PAIRS + FLOOR**2)
"""(6,) scatter of a check (rad, m)."""

WINDOW = np.array([*np.radians([0.04, 0.03, 0.08]), 0.010, 0.015, 0.020])
"""(6,) scatter of a window (rad, m): halves of five KITTI-360 frames differ by 0.045, 0.03 and 0.12°, and 25 frames are
five such; translations end within some centimetres."""

LENS_RAD = radians(0.02)
"""What all windows of a camera share."""

BUILT = np.array([radians(0.5)] * 3 + [0.02] * 3)
"""(6,) how far sensors are from where they were meant to be."""

TAILS = 3.0
"""Degrees of freedom of the Student distribution of checks and windows; the attribution believes in four."""

STREET_S = 60.0
"""How long a street lasts, on average."""

PERIODS_S = (5.0, 10.0, 15.0)
"""Between two checks of a pair, one of these per pair and drive; after one that is flagged the next comes after the
shortest of them, as who schedules looks puts suspicions first."""

FLAGGED = 4.0
"""Standard deviations on any axis, beyond which a check is flagged: about one in a hundred is by chance."""

LATE_S = 3.0
"""By how much an answer may come late, at most: others overtake it."""

BAD, BAD_LASTS, SAME, FAINT, FAINT_BAD, MISSING, BLIND = 0.02, 0.5, 0.1, 0.1, 0.5, 0.1, 0.05
"""Shares: of checks that begin a bad run, and that continue one; of these at the very place of the one before; with
faint edges, and those of them that are bad; without an answer; and of pairs of sensors that stand still, which have
none in a whole drive."""

BIASED = 2.0
"""Times the bias of the others that one pair of each rig has."""

POOR, POOREST = 0.2, 3.0
"""Share of streets on which the looks at a pair scatter by more than on others, and by how many times at most: looks at
right mounts with the faintest contrast lie 2.6 standard deviations of a street off (`monitor.dispersion`). Who looks
says nothing of it."""

CHECK_S = 4.0
"""From the first frame of a check to its last."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnRig:
    """A rig as it is meant to be."""

    name: str
    poses: Poses
    graph: RigGraph


def _camera(yaw_deg: float, x: float, y: float, z: float) -> Matrix4:
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # camera <- vehicle, looking ahead
    turned = se3.rotation_exp(np.array([0.0, 0.0, yaw_deg * pi / 180.0]))
    return se3.inverse(se3.transform_from(turned @ axes.T, np.array([x, y, z])))


def _lidar(yaw_deg: float, x: float, y: float, z: float) -> Matrix4:
    turned = se3.rotation_exp(np.array([0.0, 0.0, yaw_deg * pi / 180.0]))
    return se3.inverse(se3.transform_from(turned, np.array([x, y, z])))


CAMERAS = {
    "front": _camera(0.0, 3.5, 0.0, 0.8),
    "left": _camera(90.0, 1.8, 1.0, 1.0),
    "rear": _camera(180.0, -0.9, 0.0, 0.9),
    "right": _camera(-90.0, 1.8, -1.0, 1.0),
}
"""Four fisheyes of a car, its ego frame x forward, y left, z up (m)."""

ROOF = {"roof": _lidar(0.0, 1.2, 0.0, 1.9)}
SHORT = {"short_left": _lidar(60.0, 3.2, 0.9, 0.6), "short_right": _lidar(-60.0, 3.2, -0.9, 0.6)}


def _rig(name: str, poses: Poses, pairs: Sequence[tuple[str, str]]) -> DrawnRig:
    sensors = [Sensor(one, Kind.CAMERA if one in CAMERAS else Kind.LIDAR) for one in poses]
    edges = [Edge(f"{a}-{b}", a, b, poses[a] @ se3.inverse(poses[b])) for a, b in pairs]
    return DrawnRig(name, poses, RigGraph.of(sensors, edges))


SINGLE = _rig("one camera, one LiDAR", {"front": CAMERAS["front"], **ROOF}, [("front", "roof")])
FOUR = _rig("four cameras, one LiDAR", {**CAMERAS, **ROOF}, [(camera, "roof") for camera in CAMERAS])
FULL = _rig(
    "four cameras, three LiDARs",
    {**CAMERAS, **ROOF, **SHORT},
    [
        *((camera, "roof") for camera in CAMERAS),
        *((camera, "short_left") for camera in ("front", "left", "rear")),
        *((camera, "short_right") for camera in ("front", "right", "rear")),
        ("roof", "short_left"),
        ("roof", "short_right"),
    ],
)


def moved(poses: Poses, who: Sequence[str], angle_rad: float, rng: np.random.Generator) -> Poses:
    """The poses after some sensors turned by an angle about axes of their own."""
    return {
        name: se3.perturb(pose, np.concatenate([angle_rad * random_direction(rng), np.zeros(3)]))
        if name in who
        else pose
        for name, pose in poses.items()
    }


def off(poses: Poses, sigma: Array, rng: np.random.Generator) -> Poses:
    """Each sensor off by (6,) standard deviations."""
    return {name: se3.perturb(pose, sigma * rng.normal(size=6)) for name, pose in poses.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """Something else that displaces one edge alone, by ξ (6,)."""

    edge: str
    xi: Array


def checks(
    rig: DrawnRig, before: Poses, after: Poses, bend: Bend | None, at_s: float, until_s: float, rng: np.random.Generator
) -> list[Look]:
    """Looks of a drive in the order in which they come, the sensors being elsewhere from `at_s` on."""
    found: list[tuple[float, Look]] = []
    biased = int(rng.integers(len(rig.graph.edges)))
    for number, edge in enumerate(rig.graph.edges):
        bias = UNCOMMISSIONED_BIAS * rng.normal(size=6) * (BIASED if number == biased else 1.0)
        still = all(np.array_equal(before[name], after[name]) for name in (edge.a, edge.b))
        blind = still and rng.random() < BLIND
        period_s = float(rng.choice(PERIODS_S))
        at, street, bad = float(rng.uniform(0.0, period_s)), STREET * rng.normal(size=6), np.zeros(6)
        right = se3.difference(before[edge.a] @ se3.inverse(before[edge.b]), edge.T_a_b)
        in_run, poor, suspected_ns = False, _poor(rng), None
        while at < until_s:
            poses = before if at < at_s else after
            here = se3.difference(poses[edge.a] @ se3.inverse(poses[edge.b]), edge.T_a_b)
            if bend is not None and edge.name == bend.edge and at >= at_s:
                here = here + bend.xi
            faint = bool(rng.random() < FAINT)
            scatter = CHECK * (WEAK_TIMES if faint else 1.0)
            told = scatter * rng.standard_t(TAILS, size=6) / np.sqrt(TAILS / (TAILS - 2.0))
            seen = here + bias + poor * (street + told)
            if not in_run or rng.random() >= SAME:
                bad = REACH * rng.normal(size=6)
            in_run = bool(rng.random() < (BAD_LASTS if in_run else BAD))
            if in_run or (faint and rng.random() < FAINT_BAD):
                seen = bad + CHECK * rng.normal(size=6)
            late_s = float(rng.uniform(0.0, LATE_S))
            flagged = float((np.abs(seen - right) / np.hypot(CHECK, UNCOMMISSIONED_BIAS)).max()) > FLAGGED
            if not blind and rng.random() >= MISSING:
                if not flagged:
                    suspected_ns = None
                elif suspected_ns is None:
                    suspected_ns = round((at - CHECK_S) * NS_PER_S)
                found.append((at + late_s, _look(edge, at, seen, scatter, faint, suspected_ns)))
            if rng.random() < period_s / STREET_S:
                street, poor = STREET * rng.normal(size=6), _poor(rng)
            at += PERIODS_S[0] if flagged and not faint else period_s
    return [look for _, look in sorted(found, key=lambda one: (one[0], one[1].edge))]


def _poor(rng: np.random.Generator) -> float:
    """Times the scatter of others that looks at one pair in a street have."""
    return float(rng.uniform(1.0, POOREST)) if rng.random() < POOR else 1.0


def _look(edge: Edge, at_s: float, xi: Array, scatter: Array, faint: bool, suspected_ns: int | None) -> Look:
    return Look(
        edge=edge.name,
        stamp_ns=round(at_s * NS_PER_S),
        T_a_b=se3.perturb(edge.T_a_b, xi),
        information=information_of(np.diag(scatter**2)),
        place=STREET,
        rig=UNCOMMISSIONED_BIAS,
        weak=faint,
        stepped_ns=suspected_ns,
    )


Lenses = Mapping[str, Array]
"""(2,) by how many standard deviations the lens of each camera is displaced, down and across, by name."""


def lenses(rig: DrawnRig, rng: np.random.Generator) -> Lenses:
    """Of a rig: all windows of a camera share what its lens does."""
    return {name: rng.normal(size=2) for name in rig.poses}


def windows(
    rig: DrawnRig, poses: Poses, lens: Lenses, rng: np.random.Generator, off_by_rad: float = 0.0
) -> dict[str, Measurement]:
    """One window of each edge. One of them lies beside by an angle, if that is not zero: the first."""
    found = {}
    for number, edge in enumerate(rig.graph.edges):
        sigma = WINDOW * np.exp(0.3 * rng.normal(size=6))
        noise = np.diag(sigma**2)
        # Far things tell pitch from height badly, and yaw from a shift to the side.
        for one, other, sign in ((0, 4, 1.0), (1, 3, -1.0)):
            noise[one, other] = noise[other, one] = sign * 0.7 * sigma[one] * sigma[other]
        error = np.linalg.cholesky(noise) @ (rng.standard_t(TAILS * 2.0, size=6) / np.sqrt(1.5))
        shared: dict[str, Array] = {}
        if edge.a in CAMERAS:
            shared = {"lens_down": LENS_RAD * np.eye(6)[0], "lens_across": LENS_RAD * np.eye(6)[1]}
            error = error + shared["lens_down"] * lens[edge.a][0] + shared["lens_across"] * lens[edge.a][1]
        if number == 0 and off_by_rad > 0.0:
            error = error + np.concatenate([off_by_rad * random_direction(rng), np.zeros(3)])
        T_a_b = se3.perturb(poses[edge.a] @ se3.inverse(poses[edge.b]), error)
        found[edge.name] = Measurement(T_a_b, Uncertainty(noise, shared, float("nan")), 0)
    return found
