"""Simulated evidence of a rig: what checks and windows of its pairs report, with all the errors that real ones have.

Each pair has an estimator with a bias of its own, and one pair has a larger bias than the others. A street displaces
all checks of a pair alike for as long as it lasts. Single checks scatter with longer tails than the attribution
assumes; they are bad in runs, faint, late, or missing for a whole drive. Sizes are those of `commissioning.baseline`,
measured on the recordings; the shares are worse than those seen on simulated drives (`monitor.likelihood`). Checks
between two LiDARs scatter as on rendered streets, and come when the service would have them. When a pair suspects a
move, a window is cut at once, and its result counts in addition to the checks (`calibration.monitor.urgency`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import FLOOR, PRIOR_SPREAD_POSE, PRIOR_SPREAD_ROTATION, STREET, UNCOMMISSIONED_BIAS
from coec.calibration.frames.window import TRIES
from coec.calibration.monitor.sequential_tests import WEAK_TIMES
from coec.calibration.rig import edge_observations
from coec.calibration.rig.graph import Edge, RigGraph, Sensor, SensorKind
from coec.calibration.tracker import Measurement
from coec.calibration.types import Matrix4, Uncertainty
from coec.config import LidarEdgesConfig, MonitorConfig
from coec.geometry import se3
from coec.geometry.points import random_direction
from coec_lab.experiments.check_drives import CHECK_PAIRS

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
"""Standard deviation of the displacement that all windows of a camera share."""

BUILT = np.array([radians(0.5)] * 3 + [0.02] * 3)
"""(6,) standard deviation of sensors from where they were meant to be (rad, m)."""

TAILS = 3.0
"""Degrees of freedom of the Student distribution of checks and windows; the attribution assumes four."""

STREET_S = 60.0
"""How long a street lasts, on average."""

PERIODS_S = (5.0, 10.0, 15.0)
"""Time between two checks of a pair: one of these per pair and drive. After a flagged check the next one comes after
the shortest of these, because the scheduler of looks puts suspicions first."""

FLAGGED = 4.0
"""A check is flagged beyond so many standard deviations on any axis: about one in a hundred is flagged by chance."""

LATE_S = 3.0
"""By how much an answer may be late, at most, so that others overtake it."""

BAD, BAD_LASTS, SAME, FAINT, FAINT_BAD, MISSING, BLIND = 0.02, 0.5, 0.1, 0.1, 0.5, 0.1, 0.05
"""Shares, in this order: checks that begin a bad run; bad checks that continue one; bad checks at exactly the place of
the one before; checks with faint edges; faint checks that are bad; checks without an answer; and pairs of sensors that
do not move that have no answer in a whole drive."""

BIASED = 2.0
"""One pair of each rig has so many times the bias of the others."""

POOR, POOREST = 0.2, 3.0
"""Share of streets on which the looks at a pair scatter more than on others, and by how many times at most: looks at
right mounts with the faintest contrast lie 2.6 standard deviations of a street off (`monitor.dispersion`). The looks
do not report it."""

CHECK_S = 4.0
"""Time from the first frame of a check to its last."""

LIDAR_CHECK = np.array([*np.radians([0.037, 0.020, 0.015]), 0.0092, 0.0040, 0.0048])
"""(6,) standard deviation that a look at two LiDARs claims (rad, m): the median of 48 looks on six simulated streets
(seeds 52000 to 52005), a roof LiDAR and one on each flank."""

LIDAR_PERIOD_S, LIDAR_LATE_S = LidarEdgesConfig().period_s, 17.0
"""Time between two looks at two LiDARs (all LiDAR edges of a vehicle at once), and from a look's first sweep to when it
counts."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRig:
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


def _rig(name: str, poses: Poses, pairs: Sequence[tuple[str, str]]) -> SimulatedRig:
    sensors = [Sensor(one, SensorKind.CAMERA if one in CAMERAS else SensorKind.LIDAR) for one in poses]
    edges = [Edge(f"{a}-{b}", a, b, poses[a] @ se3.inverse(poses[b])) for a, b in pairs]
    return SimulatedRig(name, poses, RigGraph.of(sensors, edges))


SINGLE = _rig("one camera, one LiDAR", {"front": CAMERAS["front"], **ROOF}, [("front", "roof")])
FOUR = _rig("four cameras, one LiDAR", {**CAMERAS, **ROOF}, [(camera, "roof") for camera in CAMERAS])
_OF_CAMERAS = [
    *((camera, "roof") for camera in CAMERAS),
    *((camera, "short_left") for camera in ("front", "left", "rear")),
    *((camera, "short_right") for camera in ("front", "right", "rear")),
]
UNLINKED = _rig("four cameras, three LiDARs, none between these", {**CAMERAS, **ROOF, **SHORT}, _OF_CAMERAS)
FULL = _rig(
    "four cameras, three LiDARs",
    {**CAMERAS, **ROOF, **SHORT},
    [*_OF_CAMERAS, ("roof", "short_left"), ("roof", "short_right")],
)


def moved(poses: Poses, who: Sequence[str], angle_rad: float, rng: np.random.Generator) -> Poses:
    """The poses after the sensors `who` turned by an angle, each about its own random axis."""
    return {
        name: se3.perturb(pose, np.concatenate([angle_rad * random_direction(rng), np.zeros(3)]))
        if name in who
        else pose
        for name, pose in poses.items()
    }


def off(poses: Poses, sigma: Array, rng: np.random.Generator) -> Poses:
    """The poses with each sensor off at random, by standard deviations `sigma` (6,)."""
    return {name: se3.perturb(pose, sigma * rng.normal(size=6)) for name, pose in poses.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """Something other than a sensor's move that displaces one edge alone, by ξ (6,)."""

    edge: str
    xi: Array


@dataclass(frozen=True, slots=True, eq=False)
class Happening:
    """What happens on a drive: from `at_s` on sensors are elsewhere, and an edge may be bent. It ends at `until_s`."""

    before: Poses
    after: Poses
    bend: Bend | None
    at_s: float
    until_s: float

    def where(self, edge: Edge, at_s: float) -> Array:
        """(6,) ξ by which an edge is off at a time."""
        poses = self.before if at_s < self.at_s else self.after
        here = se3.difference(poses[edge.a] @ se3.inverse(poses[edge.b]), edge.T_a_b)
        if self.bend is not None and edge.name == self.bend.edge and at_s >= self.at_s:
            return np.asarray(here + self.bend.xi)
        return here

    def is_blind(self, edge: Edge, rng: np.random.Generator) -> bool:
        """Whether an edge has no looks in this drive; only an edge whose sensors do not move can have none."""
        still = all(np.array_equal(self.before[name], self.after[name]) for name in (edge.a, edge.b))
        return still and bool(rng.random() < BLIND)


TimedEvidence = tuple[float, edge_observations.EdgeObservation]
"""The time at which a look becomes known, s, and the look."""


def simulate_checks(rig: SimulatedRig, drive: Happening, rng: np.random.Generator) -> list[TimedEvidence]:
    """All looks of a drive, in the order in which they become known."""
    evidence: list[TimedEvidence] = []
    biased = int(rng.integers(len(rig.graph.edges)))
    lidars_at_s = float(rng.uniform(0.0, LIDAR_PERIOD_S))
    for number, edge in enumerate(rig.graph.edges):
        if edge.name in rig.graph.of_lidars:
            evidence += _lidar_checks(edge, drive, lidars_at_s, rng)
        else:
            evidence += _checks(edge, drive, BIASED if number == biased else 1.0, rng)
    return sorted(evidence, key=lambda one: (one[0], one[1].edge))


def _checks(edge: Edge, drive: Happening, biased: float, rng: np.random.Generator) -> list[TimedEvidence]:
    """Checks of one pair of a camera and a LiDAR."""
    evidence: list[TimedEvidence] = []
    bias = UNCOMMISSIONED_BIAS * rng.normal(size=6) * biased
    blind = drive.is_blind(edge, rng)
    period_s = float(rng.choice(PERIODS_S))
    at, street, bad = float(rng.uniform(0.0, period_s)), STREET * rng.normal(size=6), np.zeros(6)
    right = drive.where(edge, -1.0)
    in_run, poor, suspected_ns = False, _poor(rng), None
    while at < drive.until_s:
        faint = bool(rng.random() < FAINT)
        scatter = CHECK * (WEAK_TIMES if faint else 1.0)
        seen = drive.where(edge, at) + bias + poor * (street + _student(scatter, rng))
        if not in_run or rng.random() >= SAME:
            bad = edge_observations.REACH * rng.normal(size=6)
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
            evidence.append((at + late_s, _check_evidence(edge, at, seen, scatter, faint, suspected_ns)))
        if rng.random() < period_s / STREET_S:
            street, poor = STREET * rng.normal(size=6), _poor(rng)
        at += PERIODS_S[0] if flagged and not faint else period_s
    return evidence


def _lidar_checks(edge: Edge, drive: Happening, at_s: float, rng: np.random.Generator) -> list[TimedEvidence]:
    """Looks at two LiDARs, the first of them at `at_s`."""
    evidence: list[TimedEvidence] = []
    bias, street = edge_observations.BIAS * rng.normal(size=6), edge_observations.PLACE * rng.normal(size=6)
    blind = drive.is_blind(edge, rng)
    while at_s < drive.until_s:
        sigma = _varied(LIDAR_CHECK, rng)
        seen = drive.where(edge, at_s) + bias + street + _student(sigma, rng)
        if rng.random() < BAD:
            seen = edge_observations.REACH * rng.normal(size=6)
        if not blind and rng.random() >= MISSING:
            T_a_b = se3.perturb(edge.T_a_b, seen)
            check = edge_observations.observation_of_registration(
                edge.name, round(at_s * NS_PER_S), T_a_b, np.diag(sigma**2)
            )
            evidence.append((at_s + LIDAR_LATE_S, check))
        if rng.random() < LIDAR_PERIOD_S / STREET_S:
            street = edge_observations.PLACE * rng.normal(size=6)
        at_s += LIDAR_PERIOD_S
    return evidence


def _student(sigma: Array, rng: np.random.Generator) -> Array:
    """(6,) a random error with these standard deviations and long tails."""
    return np.asarray(sigma * rng.standard_t(TAILS, size=6) / np.sqrt(TAILS / (TAILS - 2.0)))


def _varied(sigma: Array, rng: np.random.Generator) -> Array:
    """(6,) the standard deviations that one look or window claims, varied about the usual ones."""
    return np.asarray(sigma * np.exp(0.3 * rng.normal(size=6)))


def _poor(rng: np.random.Generator) -> float:
    """By how many times the looks at one pair in a street scatter more than usual."""
    return float(rng.uniform(1.0, POOREST)) if rng.random() < POOR else 1.0


def _check_evidence(
    edge: Edge, at_s: float, xi: Array, scatter: Array, faint: bool, suspected_ns: int | None
) -> edge_observations.EdgeObservation:
    return edge_observations.EdgeObservation(
        edge=edge.name,
        stamp_ns=round(at_s * NS_PER_S),
        T_a_b=se3.perturb(edge.T_a_b, xi),
        information=edge_observations.information_of(np.diag(scatter**2)),
        place=STREET,
        rig=UNCOMMISSIONED_BIAS,
        weak=faint,
        stepped_ns=suspected_ns,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Lasting:
    """Errors that all windows of a rig share.

    Attributes:
        lens: (2,) by how many standard deviations the lens of each camera is displaced, down and across; by name.
        between: (6,) bias of looks at two LiDARs, by edge.
    """

    lens: Mapping[str, Array]
    between: Mapping[str, Array]

    @classmethod
    def of(cls, rig: SimulatedRig, rng: np.random.Generator) -> Lasting:
        """Drawn."""
        lens = {name: rng.normal(size=2) for name in rig.poses}
        return cls(lens, {name: edge_observations.BIAS * rng.normal(size=6) for name in sorted(rig.graph.of_lidars)})


def windows(
    rig: SimulatedRig, poses: Poses, lasting: Lasting, rng: np.random.Generator, off_by_rad: float = 0.0
) -> dict[str, Measurement]:
    """One window of each edge between a camera and a LiDAR, one look of each edge between LiDARs. The first is turned
    from its true pose by `off_by_rad`."""
    measurements = {}
    for number, edge in enumerate(rig.graph.edges):
        T_a_b = poses[edge.a] @ se3.inverse(poses[edge.b])
        if number == 0 and off_by_rad > 0.0:
            T_a_b = se3.perturb(T_a_b, np.concatenate([off_by_rad * random_direction(rng), np.zeros(3)]))
        if edge.name in rig.graph.of_lidars:
            measurements[edge.name] = _lidar_check_as_window(T_a_b, lasting.between[edge.name], rng)
        else:
            measurements[edge.name] = window_of(T_a_b, lasting.lens[edge.a], rng)
    return measurements


def window_of(T_a_b: Matrix4, lens: Array, rng: np.random.Generator) -> Measurement:
    """A window of a camera and a LiDAR at the true pose (4, 4), the lens displaced by (2,) standard deviations."""
    sigma = _varied(WINDOW, rng)
    noise = np.diag(sigma**2)
    # Far objects hardly distinguish pitch from height, or yaw from a sideways shift.
    for one, other, sign in ((0, 4, 1.0), (1, 3, -1.0)):
        noise[one, other] = noise[other, one] = sign * 0.7 * sigma[one] * sigma[other]
    error = np.linalg.cholesky(noise) @ (rng.standard_t(TAILS * 2.0, size=6) / np.sqrt(1.5))
    shared = {"lens_down": LENS_RAD * np.eye(6)[0], "lens_across": LENS_RAD * np.eye(6)[1]}
    error = error + shared["lens_down"] * lens[0] + shared["lens_across"] * lens[1]
    return Measurement(se3.perturb(T_a_b, error), Uncertainty(noise, shared, float("nan")), 0)


def _lidar_check_as_window(T_a_b: Matrix4, bias: Array, rng: np.random.Generator) -> Measurement:
    """A look at two LiDARs at the true pose (4, 4), in the form of a window."""
    sigma = _varied(LIDAR_CHECK, rng)
    error = bias + edge_observations.PLACE * rng.normal(size=6) + _student(sigma, rng)
    return edge_observations.window_of(0, se3.perturb(T_a_b, error), np.diag(sigma**2))


SLICE_S = MonitorConfig().urgent_slice_s

SUSPECTED = 2
"""Flagged looks in a row after which a pair suspects a move: a simulated vehicle that is looked at every five seconds
suspects after nine."""

TAKES_S = (3.0, 18.0)
"""From the end of a slice to its answer: a window of 25 frames takes the worker four seconds, and up to four pairs of a
knocked LiDAR wait for each other."""

ACCEPTED = 0.7
"""Share of windows that are accepted: 73 of 108 on the simulated streets of `coec sim matrix`, including night, rain
and wrong lenses. None of them was wrong."""


def urgent_evidence(
    rig: SimulatedRig, drive: Happening, checks: Sequence[TimedEvidence], lasting: Lasting, rng: np.random.Generator
) -> list[TimedEvidence]:
    """Results of accepted windows, in the order in which they become known; `looks` are those at all pairs."""
    evidence: list[TimedEvidence] = []
    for edge in rig.graph.edges:
        if edge.name not in rig.graph.of_lidars:
            evidence += _of_pair(edge, drive, [one for one in checks if one[1].edge == edge.name], lasting, rng)
    return sorted(evidence, key=lambda one: (one[0], one[1].edge))


def _of_pair(
    edge: Edge, drive: Happening, checks: Sequence[TimedEvidence], lasting: Lasting, rng: np.random.Generator
) -> list[TimedEvidence]:
    """Results for one pair: at most `TRIES` windows per suspicion, one after the other."""
    evidence: list[TimedEvidence] = []
    flagged, tries, known_s = 0, 0, -np.inf
    for at_s, check in checks:
        if check.stepped_ns is None:
            flagged = tries = 0
            continue
        flagged += 1
        if flagged < SUSPECTED or tries == TRIES or at_s < known_s:
            continue
        tries += 1
        end_s = at_s + SLICE_S
        known_s = end_s + float(rng.uniform(*TAKES_S))
        offset_at_start, offset_at_end = drive.where(edge, at_s), drive.where(edge, end_s)
        # A window during which the mount moved is refused.
        if rng.random() < ACCEPTED and np.array_equal(offset_at_start, offset_at_end):
            measured = window_of(se3.perturb(edge.T_a_b, offset_at_end), lasting.lens[edge.a], rng)
            window_evidence = edge_observations.observation_of_window(edge.name, measured)
            assert window_evidence is not None
            evidence.append((known_s, replace(window_evidence, stamp_ns=round(at_s * NS_PER_S))))
    return evidence
