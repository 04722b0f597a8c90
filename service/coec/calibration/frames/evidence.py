"""What a recording shows of how it was made: by the points of its sweeps, whether their driver has compensated them for
motion, how many clouds make up a turn, and whether the vehicle stood; by the poses of its odometry, how the velocities
in the same messages are meant.

A LiDAR that turns evenly measures along each beam at azimuths that grow linearly with time. Compensation for the motion
of the vehicle spoils that, by degrees for points beside a vehicle at some metres per second, and undoing it restores
it. So the points themselves show whether they were compensated, and for which instant, if they have times.

`nav_msgs/Odometry` has the pose of the child frame in the parent frame, and the velocity in the child frame. Programs
fill in one of them only, or give the velocity in the parent frame, or backwards. For two poses T₁ and T₂, dt apart, the
velocity in the child frame is log(T₁⁻¹·T₂)/dt, at the middle between the two.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion, LidarFrame, Matrix4
from coec.geometry import se3
from coec.geometry.points import lengths

POINTS, NEAR_M, FAR_M = 6000, 2.0, 40.0
"""How many points of a sweep are used, and their ranges: the vehicle itself moves along, far points hardly move."""

MIN_POINTS = 12
"""Fewer points of a beam say nothing."""

LEAST_SPEED_MPS, LEAST_SWEEP_S = 2.0, 0.02
"""Slower vehicles and shorter sweeps are hardly compensated."""

RESTORED = 0.5
"""Points were compensated if undoing it leaves at most this share of the deviation from an even turn. See
docs/measured.md."""

AGREEING, LEAST_SWEEPS = 0.75, 3
"""Least share of the sweeps, and number of sweeps, that must show the same."""


def compensated_for(sweeps: Sequence[tuple[LidarFrame, EgoMotion]], T_lidar_ego: Matrix4) -> str | None:
    """The instant for which the points of sweeps were compensated before they were recorded, as a name in `instants_s`;
    None if they were not, or if that is unknown: for LiDARs that do not turn, without times, and while the vehicle
    stands. `T_lidar_ego` (4, 4) is the pose of the vehicle in the LiDAR's frame."""
    votes = Counter(
        _vote(sweep, motion, T_lidar_ego)
        for sweep, motion in sweeps
        if motion.reaches(LEAST_SPEED_MPS)
        and sweep.time_offset_s is not None
        and np.ptp(sweep.time_offset_s) >= LEAST_SWEEP_S
    )
    (instant, count), *_ = votes.most_common(1) or [(None, 0)]
    return instant if count >= max(LEAST_SWEEPS, AGREEING * votes.total()) else None


def are_raw(sweeps: Sequence[tuple[LidarFrame, EgoMotion]], T_lidar_ego: Matrix4) -> bool:
    """Whether sweeps were certainly not compensated before they were recorded: they turn evenly as they are, and no
    longer if a compensation is undone, whatever the motion. False where that is unknown, see `compensated_for`."""
    votes = []
    for sweep, motion in sweeps:
        if sweep.time_offset_s is None or not motion.reaches(LEAST_SPEED_MPS):
            continue
        as_given, undone = _unevenness_by_instant(sweep, motion, T_lidar_ego)
        votes.append(as_given < RESTORED * min(undone.values()))
    return len(votes) >= LEAST_SWEEPS and sum(votes) >= AGREEING * len(votes)


def instants_s(sweep: LidarFrame) -> dict[str, float]:
    """The instants for which drivers compensate a sweep, seconds after its stamp, by name; none without times."""
    if sweep.time_offset_s is None:
        return {}
    begin_s, end_s = float(sweep.time_offset_s.min()), float(sweep.time_offset_s.max())
    return {"stamp": 0.0, "begin": begin_s, "end": end_s, "middle": 0.5 * (begin_s + end_s)}


def _vote(sweep: LidarFrame, motion: EgoMotion, T_lidar_ego: Matrix4) -> str | None:
    """The instant for which the points of one sweep were compensated; None: for none."""
    as_given, undone = _unevenness_by_instant(sweep, motion, T_lidar_ego)
    best = min(undone, key=lambda name: undone[name])
    return best if undone[best] < RESTORED * as_given else None


def _unevenness_by_instant(
    sweep: LidarFrame, motion: EgoMotion, T_lidar_ego: Matrix4
) -> tuple[float, dict[str, float]]:
    """The unevenness of a sweep with times, as it is, and if its compensation for each instant is undone, radians."""
    # Imported here because the process that serves has no compiler, and asks only for the rest of this module.
    from coec.calibration.frames.motion_compensation import sensor_twist
    from coec.geometry.sweep_kernels import deskew

    range_m = lengths(sweep.xyz_m)
    selected = np.flatnonzero((range_m > NEAR_M) & (range_m < FAR_M))
    selected = selected[:: max(1, len(selected) // POINTS)]
    assert sweep.time_offset_s is not None
    times_s = sweep.time_offset_s[selected].astype(np.float64)
    xyz_m = np.ascontiguousarray(sweep.xyz_m[selected])
    beam = np.zeros(len(selected), np.uint16) if sweep.ring is None else sweep.ring[selected]
    angular_radps, linear_mps = sensor_twist(motion, T_lidar_ego)
    as_given = _unevenness_rad(xyz_m, times_s, beam)
    undone = {
        name: _unevenness_rad(deskew(xyz_m, instant_s - times_s, angular_radps, linear_mps), times_s, beam)
        for name, instant_s in instants_s(sweep).items()
    }
    return as_given, undone


def _unevenness_rad(xyz_m: NDArray[np.float32], times_s: NDArray[np.float64], beam: NDArray[np.uint16]) -> float:
    """Median deviation of the azimuths from a line over time, each beam for itself; infinite if no beam tells."""
    order = np.lexsort((times_s, beam))
    x_m, y_m = xyz_m[order, 0].astype(np.float64), xyz_m[order, 1].astype(np.float64)
    azimuth, times_s = np.arctan2(y_m, x_m), times_s[order]
    ends = np.flatnonzero(np.diff(beam[order])) + 1
    deviations = []
    for angle, at_s in zip(np.split(azimuth, ends), np.split(times_s, ends), strict=True):
        half = len(angle) // 2
        if len(angle) < MIN_POINTS or at_s[-1] - at_s[0] < LEAST_SWEEP_S:
            continue
        angle = np.unwrap(angle)
        between_s = np.maximum(at_s[half : 2 * half] - at_s[:half], 1e-6)
        rate = np.median((angle[half : 2 * half] - angle[:half]) / between_s)
        from_line = angle - rate * at_s
        deviations.append(np.abs(from_line - np.median(from_line)))
    return float(np.median(np.concatenate(deviations))) if deviations else float("inf")


SECTORS, WHOLE = 36, 0.6
"""Sectors of azimuth, and the share of them from which on a cloud counts as a whole turn."""

FLAT, STEEP = 0.75, 0.95
"""The sine of the elevations of a LiDAR about its axis of rotation stays below the first, in 99 % of its points; about
every other axis it exceeds the second."""

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


def upright_axes(sweeps: Sequence[LidarFrame]) -> NDArray[np.float64] | None:
    """The rotation (3, 3) into axes with z up or down, of a turning LiDAR whose clouds are given in axes with x or y
    upright; None for every other LiDAR, and for one that turns about z."""
    xyz_m = np.concatenate([sweep.xyz_m for sweep in sweeps]).astype(np.float64)
    range_m = np.sqrt((xyz_m**2).sum(axis=1))
    seen = range_m > 0.0
    if not seen.any():
        return None
    sine = np.percentile(np.abs(xyz_m[seen] / range_m[seen, None]), 99, axis=0)
    axis = int(sine.argmin())
    if axis == 2 or sine[axis] > FLAT or np.delete(sine, axis).min() < STEEP:
        return None
    x, z = np.eye(3)[axis + 1], -np.eye(3)[axis]
    return np.stack([x, np.cross(z, x), z])


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


UNCHANGED_SHARE = 0.8
"""The vehicle stood if at least this share of the directions have the same range in two sweeps. A flat ground and the
walls of a straight road are alike wherever a vehicle is; people and boards before a standing one change few. See
docs/measured.md."""

SAME_RANGE, SAME_RANGE_M = 0.02, 0.1
"""Ranges are the same if they differ by at most this share, or by so much."""


def stands(sweeps: Sequence[LidarFrame]) -> bool:
    """Whether the vehicle stood at one place while some sweeps were recorded: most pairs of sweeps that are half of
    them apart show the same ranges."""
    nearest, half = [_nearest_m(sweep) for sweep in sweeps], len(sweeps) // 2
    shares = []
    for one, other in zip(nearest, nearest[half:] if half else [], strict=False):
        seen = np.isfinite(one) & np.isfinite(other)
        same = np.abs(one[seen] - other[seen]) <= np.maximum(SAME_RANGE_M, SAME_RANGE * one[seen])
        shares.append(float(same.mean()) if len(same) else 0.0)
    return bool(shares) and float(np.median(shares)) >= UNCHANGED_SHARE


def _nearest_m(sweep: LidarFrame) -> NDArray[np.float64]:
    """(180 · 360,) the range of the nearest point in each square degree of elevation and azimuth, m; infinite without a
    point."""
    xyz_m = sweep.xyz_m.astype(np.float64)
    xyz_m = xyz_m[np.isfinite(xyz_m).all(axis=1)]
    azimuth = np.floor(np.degrees(np.arctan2(xyz_m[:, 1], xyz_m[:, 0]))).astype(np.int64) % 360
    elevation = np.degrees(np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1])))
    row = np.clip(np.floor(elevation) + 90.0, 0.0, 179.0).astype(np.int64)
    nearest_m = np.full(180 * 360, np.inf)
    np.minimum.at(nearest_m, row * 360 + azimuth, lengths(xyz_m))
    return nearest_m


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
