"""What the points of sweeps show: whether their driver has compensated them for motion, how many clouds make up a turn,
and whether the vehicle stood.

A LiDAR that turns evenly measures along each beam at azimuths that grow linearly with time. Compensation for the motion
of the vehicle spoils that, by degrees for points beside a vehicle at some metres per second, and undoing it restores
it. So the points themselves show whether they were compensated, and for which instant, if they have times.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.types import EgoMotion, LidarFrame, Matrix4
from coec.geometry.points import lengths
from coec.geometry.sweep_kernels import deskew

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


def instants_s(sweep: LidarFrame) -> dict[str, float]:
    """The instants for which drivers compensate a sweep, seconds after its stamp, by name; none without times."""
    if sweep.time_offset_s is None:
        return {}
    begin_s, end_s = float(sweep.time_offset_s.min()), float(sweep.time_offset_s.max())
    return {"stamp": 0.0, "begin": begin_s, "end": end_s, "middle": 0.5 * (begin_s + end_s)}


def _vote(sweep: LidarFrame, motion: EgoMotion, T_lidar_ego: Matrix4) -> str | None:
    """The instant for which the points of one sweep were compensated; None: for none."""
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
    best = min(undone, key=lambda name: undone[name])
    return best if undone[best] < RESTORED * as_given else None


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
