"""LiDAR odometry: the motion of a vehicle from consecutive sweeps of its LiDAR, for recordings that have no other.

The later sweep is registered to the earlier one, both compensated for the motion as far as it is known. What the
registration corrects is the rest of the motion, with a velocity that is constant over both sweeps. A registration leads
a metre or two, and a vehicle comes further in a tenth of a second, so registrations begin at several velocities.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import cos, radians, sin, tau

import numpy as np
from numpy.typing import NDArray

from coec.calibration.rig.lidar_registration import register
from coec.calibration.rig.lidar_sampling import LidarEdge, LidarRig, SweepPair
from coec.calibration.types import EgoMotion, LidarFrame, SweepTiming
from coec.geometry import se3
from coec.geometry.points import thinned

MAX_SEPARATION_S = 0.3
"""Largest time between consecutive sweeps that are registered, s: over more, a velocity is not constant."""

POINTS = 8_000
"""Most points of the later sweep that are registered. See docs/measured.md."""

FAST_MPS, DIRECTIONS = 20.0, 8
"""Speed of the velocities at which registrations begin beside standstill, and number of their directions in the plane
of the LiDAR. See docs/measured.md."""

ROUNDS, REFINED = 4, 3
"""Most registrations from one velocity on, and how many of the velocities are refined by more than one: those that put
most points onto surfaces."""

SEARCHES = 3
"""How often a velocity is sought from all beginnings: on a motorway none is found."""

OTHER_MPS, ABOUT_AS_MANY = 1.0, 0.9
"""A velocity is ambiguous if another one, so far away, puts at least this share of the points onto surfaces. See
docs/measured.md."""

RESTS_RAD, RESTS_M = radians(0.02), 0.005
"""Registrations end with a correction below this: at the ends of a sweep it displaces points by half of it."""

MOST_SIGMA_RAD, MOST_SIGMA_M = radians(0.2), 0.05
"""Largest standard deviations, along any axis, of a turn and a shift from one sweep to the next that are known: half of
it is left at the ends of a sweep. See docs/measured.md."""

Twist = NDArray[np.float64]


def motions_of_sweeps(
    consecutive: Iterable[tuple[LidarFrame, LidarFrame]], timing: SweepTiming | None
) -> Iterator[EgoMotion | None]:
    """The motion of a LiDAR in its own frame over each of some pairs of consecutive sweeps, with the stamp of the
    earlier one; None where the surroundings do not determine it. The velocity is None where they determine the turn
    alone, as in a tunnel, or where sweeps fit about as well at another velocity, as on a motorway.

    Args:
        consecutive: earlier and later sweep of each pair.
        timing: how the time of a point follows from its azimuth, if the sweeps do not carry it.

    Raises:
        SourceError: the optional extra `lidars` is not installed.
    """
    before, searches = np.zeros(6), 0
    for earlier, later in consecutive:
        if not 0 < later.stamp_ns - earlier.stamp_ns <= MAX_SEPARATION_S * 1e9:
            yield None
            continue
        sweeps = _ConsecutiveSweeps(earlier, _some_points(later), timing)
        ends = [sweeps.registered(before, ROUNDS), sweeps.registered(np.zeros(6), 1)]
        unambiguous = bool(before.any()) and _is_unambiguous(ends)
        if not unambiguous and searches < SEARCHES:
            searches += 1
            coarse = sorted((sweeps.registered(begin, 1) for begin in _fast()), key=lambda one: -one.edge.points)
            ends += [*(sweeps.registered(one.twist, ROUNDS) for one in coarse[:REFINED]), *coarse[REFINED:]]
            unambiguous = _is_unambiguous(ends)
        best = _best(ends)
        before = best.twist if unambiguous else np.zeros(6)
        yield best.motion(earlier, velocity=unambiguous)


@dataclass(frozen=True, slots=True, eq=False)
class _Registered:
    """A motion (6,), rad/s and m/s in the frame of the LiDAR, and the registration that led to it."""

    twist: Twist
    edge: LidarEdge

    @property
    def knows_turn(self) -> bool:
        return not self.edge.reasons and bool((self.edge.sigma[:3] <= MOST_SIGMA_RAD).all())

    @property
    def knows_velocity(self) -> bool:
        return self.knows_turn and bool((self.edge.sigma[3:] <= MOST_SIGMA_M).all())

    def motion(self, earlier: LidarFrame, *, velocity: bool) -> EgoMotion | None:
        wx, wy, wz, vx, vy, vz = self.twist.tolist()
        if not self.knows_turn:
            return None
        return EgoMotion(earlier.stamp_ns, earlier.frame_id, (vx, vy, vz) if velocity else None, (wx, wy, wz))


def _best(ends: list[_Registered]) -> _Registered:
    return max(ends, key=lambda one: one.edge.points)


def _is_unambiguous(ends: list[_Registered]) -> bool:
    """Whether the best of some ends determines a velocity, and no other of another velocity puts about as many points
    onto surfaces."""
    best = _best(ends)
    others = (one for one in ends if np.linalg.norm(one.twist[3:] - best.twist[3:]) > OTHER_MPS)
    return best.knows_velocity and all(one.edge.points < ABOUT_AS_MANY * best.edge.points for one in others)


@dataclass(frozen=True, slots=True, eq=False)
class _ConsecutiveSweeps:
    earlier: LidarFrame
    later: LidarFrame
    timing: SweepTiming | None

    def registered(self, begin: Twist, rounds: int) -> _Registered:
        """The motion that at most so many registrations lead to from `begin` (6,)."""
        here, twist = np.eye(4), begin
        between_s = (self.later.stamp_ns - self.earlier.stamp_ns) * 1e-9
        rig = LidarRig("earlier", "later", here, here, self.timing, self.timing)
        for _ in range(rounds):
            wx, wy, wz, vx, vy, vz = twist.tolist()
            motion = EgoMotion(self.earlier.stamp_ns, self.earlier.frame_id, (vx, vy, vz), (wx, wy, wz))
            edge = register(rig, [SweepPair(self.earlier, self.later, motion)])
            twist = se3.log(se3.perturb(se3.exp(twist * between_s), edge.correction)) / between_s
            largest = np.abs(edge.correction)
            if edge.reasons or (largest[:3].max() < RESTS_RAD and largest[3:].max() < RESTS_M):
                break
        return _Registered(twist, edge)


def _fast() -> list[Twist]:
    """(6,) each: velocities in the plane of the LiDAR."""
    angles = [tau * k / DIRECTIONS for k in range(DIRECTIONS)]
    return [np.array([0.0, 0.0, 0.0, FAST_MPS * cos(angle), FAST_MPS * sin(angle), 0.0]) for angle in angles]


def _some_points(sweep: LidarFrame) -> LidarFrame:
    """A sweep with `POINTS` of its points at most, and what a registration reads of them."""
    some = thinned(len(sweep.xyz_m), POINTS)
    times_s = None if sweep.time_offset_s is None else sweep.time_offset_s[some]
    return replace(sweep, xyz_m=sweep.xyz_m[some], time_offset_s=times_s, intensity=None, ring=None)
