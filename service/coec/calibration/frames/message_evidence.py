"""What the messages of a recording, or on the bus, show of how they are meant: how many clouds make up a turn, whether
the points of a cloud are in view of a camera, and how the velocities of an odometry are meant, by its poses.

`nav_msgs/Odometry` has the pose of the child frame in the parent frame, and the velocity in the child frame. Programs
fill in one of them only, or give the velocity in the parent frame, or backwards. For two poses T₁ and T₂, dt apart, the
velocity in the child frame is log(T₁⁻¹·T₂)/dt, at the middle between the two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion, LidarFrame, Matrix4
from coec.geometry import se3

AGREEING = 0.75
"""Least share of the sweeps that must show the same."""

SECTORS, WHOLE = 36, 0.6
"""Sectors of azimuth, and the share of them from which on a cloud counts as a whole turn."""

SAME = 1.2
"""Clouds of a LiDAR that does not turn cover at most this many times the sectors of one."""

MOST_CLOUDS = 48
"""Most clouds that are looked at; a turn has fewer packets that anyone sends alone."""

COVERING = 0.95
"""Share of all covered sectors that a turn has to cover."""


def sectors(sweep: LidarFrame) -> NDArray[np.bool_]:
    """(SECTORS,) the sectors of azimuth in which a cloud has points."""
    azimuth = np.arctan2(sweep.xyz_m[:, 1].astype(np.float64), sweep.xyz_m[:, 0])
    sector = ((azimuth / (2.0 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    return np.bincount(sector, minlength=SECTORS) > 0


def clouds_in_turn(covered: Sequence[NDArray[np.bool_]]) -> int:
    """How many consecutive clouds cover what all of them cover, from the sectors (SECTORS,) of consecutive clouds; 1 if
    a cloud does alone, or if too few clouds tell."""
    whole = np.any(covered, axis=0).sum() if covered else 0
    if not covered or whole <= SAME * np.median([one.sum() for one in covered]):
        return 1
    for count in range(2, len(covered) // 2 + 1):
        turns = [np.any(covered[first : first + count], axis=0).sum() for first in range(len(covered) - count + 1)]
        if np.mean(np.array(turns) >= COVERING * whole) >= AGREEING:
            return count
    return 1


IN_VIEW, OUT_OF_VIEW = 0.03, 0.3
"""Share of a sweep's points that a camera sees at least: one of 60° sees a tenth of a turning LiDAR's. And the ratio of
the points in view in two frames from which on one of them is not the camera's."""


def sees_alone(share: float | None, other: float | None) -> bool:
    """Whether points of a sweep are in view in one frame, and hardly any in another one, by the shares of them; None:
    the frame is unknown."""
    return share is not None and other is not None and share >= IN_VIEW and other < OUT_OF_VIEW * IN_VIEW


LEAST_S, MOST_S = 0.1, 0.5
"""Time between the two poses of a difference: over less, the millimetres of a filter are velocities; over more, the
velocity changes unnoticed."""

MOVING_MPS, TURNING_RADPS, STANDING = 0.5, 0.05, 0.1
"""From this speed and turn rate on, by the poses, a vehicle moves; what is stated is not filled in if it is at most
this share of that."""

LEAST_MOVES = 5
"""Fewer differences while the vehicle moves show nothing."""

FITTING, CLEARLY = 0.2, 2.0
"""A reading fits if it is off by at most this share of the speed, in the median; and it counts if the velocity as
stated is off by so many times more. See docs/measured.md."""


class TwistReading(StrEnum):
    """What the poses show of the velocities."""

    AS_STATED = "as stated"
    NOT_FILLED_IN = "not filled in"
    PARENT_FRAME = "in the parent frame, not in the child frame"
    BACKWARDS = "backwards"
    KM_PER_H = "in km/h"
    DEGREES = "given with turn rates in degrees"
    OTHER_SIGN = "given with turn rates of the other sign"
    NO_TURN = "without turn rates"
    CONTRADICTED = "contradicted by the poses"


@dataclass(frozen=True, slots=True, eq=False)
class PoseAndTwist:
    """One message: the pose of the child in its parent (4, 4), None if it is invalid; and the motion as stated."""

    T_parent_child: Matrix4 | None
    motion: EgoMotion

    @property
    def stamp_ns(self) -> int:
        """Nanoseconds."""
        return self.motion.stamp_ns


def reading_of_twists(messages: Sequence[PoseAndTwist]) -> TwistReading:
    """How velocities are meant, or turn rates where the velocities are as stated. `messages` are in the order of their
    stamps, and may have gaps. `AS_STATED` also where nothing can be told: poses that are not filled in, a vehicle that
    stands."""
    moved, stated, turned = _compared(messages)
    linear, angular = stated[:, 3:], stated[:, :3]
    of_velocity = _reading(
        moved[:, 3:],
        {
            TwistReading.AS_STATED: linear,
            TwistReading.PARENT_FRAME: np.einsum("nji,nj->ni", turned, linear),
            TwistReading.BACKWARDS: -linear,
            TwistReading.KM_PER_H: linear / 3.6,
        },
        MOVING_MPS,
    )
    if of_velocity is not TwistReading.AS_STATED:
        return of_velocity
    turns = {
        TwistReading.AS_STATED: angular,
        TwistReading.DEGREES: np.radians(angular),
        TwistReading.OTHER_SIGN: -angular,
    }
    of_turn = _reading(moved[:, :3], turns, TURNING_RADPS, or_stated=True)
    if of_turn is TwistReading.NOT_FILLED_IN:
        return TwistReading.NO_TURN
    return TwistReading.AS_STATED if of_turn is TwistReading.CONTRADICTED else of_turn


def _reading(
    moved: NDArray[np.float64],
    readings: Mapping[TwistReading, NDArray[np.float64]],
    least: float,
    *,
    or_stated: bool = False,
) -> TwistReading:
    """The reading that fits what moved (N, 3) by the poses, where that is at least `least`, `or_stated` as much."""
    rate = np.linalg.norm(moved, axis=1)
    stated = np.linalg.norm(readings[TwistReading.AS_STATED], axis=1)
    moving = (rate >= least) | ((stated >= least) & (rate > 0.0) & or_stated)
    if moving.sum() < LEAST_MOVES:
        return TwistReading.AS_STATED
    if np.median(stated[moving]) <= STANDING * least:
        return TwistReading.NOT_FILLED_IN
    off = {
        reading: float(np.median(np.linalg.norm(values - moved, axis=1)[moving] / rate[moving]))
        for reading, values in readings.items()
    }
    best = min(off, key=lambda reading: off[reading])
    if off[best] > FITTING:
        return TwistReading.CONTRADICTED
    return best if CLEARLY * off[best] <= off[TwistReading.AS_STATED] else TwistReading.AS_STATED


def motions_of_poses(messages: Sequence[PoseAndTwist]) -> tuple[EgoMotion, ...]:
    """The motion as differences of poses, in the order of stamps."""
    motions = []
    for first, last in _intervals(messages):
        a, b = messages[first], messages[last]
        assert a.T_parent_child is not None
        assert b.T_parent_child is not None
        between_s = (b.stamp_ns - a.stamp_ns) * 1e-9
        wx, wy, wz, vx, vy, vz = (se3.log(se3.inverse(a.T_parent_child) @ b.T_parent_child) / between_s).tolist()
        middle_ns = a.stamp_ns + (b.stamp_ns - a.stamp_ns) // 2
        motions.append(EgoMotion(middle_ns, a.motion.frame_id, (vx, vy, vz), (wx, wy, wz)))
    return tuple(motions)


def _intervals(messages: Sequence[PoseAndTwist]) -> list[tuple[int, int]]:
    """For each message with a pose the first one with a pose that is at least `LEAST_S` later, if it is near enough."""
    posed = [index for index, message in enumerate(messages) if message.T_parent_child is not None]
    intervals, later = [], 0
    for place, first in enumerate(posed):
        later = max(later, place + 1)
        while later < len(posed) and messages[posed[later]].stamp_ns - messages[first].stamp_ns < LEAST_S * 1e9:
            later += 1
        if later == len(posed):
            break
        if messages[posed[later]].stamp_ns - messages[first].stamp_ns <= MOST_S * 1e9:
            intervals.append((first, posed[later]))
    return intervals


def _compared(messages: Sequence[PoseAndTwist]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """(N, 6) turn rates, rad/s, and velocities, m/s, in the child frame by the poses, (N, 6) as stated, and (N, 3, 3)
    the rotation from child to parent."""
    moved, stated, turned = [], [], []
    for motion, (first, last) in zip(motions_of_poses(messages), _intervals(messages), strict=True):
        a, b = messages[first], messages[last]
        if a.motion.linear_mps is None or b.motion.linear_mps is None or a.T_parent_child is None:
            continue
        moved.append((*motion.angular_radps, *(motion.linear_mps or ())))
        twists = [(*one.motion.angular_radps, *one.motion.linear_mps) for one in (a, b) if one.motion.linear_mps]
        stated.append(np.mean(twists, axis=0))
        half = se3.rotation_exp(0.5e-9 * (b.stamp_ns - a.stamp_ns) * np.array(motion.angular_radps))
        turned.append(a.T_parent_child[:3, :3] @ half)
    count = len(moved)
    return (
        np.array(moved, np.float64).reshape(count, 6),
        np.array(stated, np.float64).reshape(count, 6),
        np.array(turned, np.float64).reshape(count, 3, 3),
    )
