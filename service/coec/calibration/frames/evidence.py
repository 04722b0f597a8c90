"""What the points of sweeps show of how they were made: whether their driver has compensated them for motion, about
which axis the LiDAR turns, and whether the vehicle stood.

A LiDAR that turns evenly measures along each beam at azimuths that grow linearly with time. Compensation for the motion
of the vehicle spoils that, by degrees for points beside a vehicle at some metres per second, and undoing it restores
it. So the points themselves show whether they were compensated, and for which instant, if they have times.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.message_evidence import AGREEING
from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.types import EgoMotion, LidarFrame, Matrix4
from coec.geometry.points import lengths
from coec.geometry.sweep_kernels import deskew

LEAST_SWEEPS = 3
"""Least number of sweeps that must show the same."""

POINTS, NEAR_M, FAR_M = 6000, 2.0, 40.0
"""How many points of a sweep are used, and their ranges: the vehicle itself moves along, far points hardly move."""

MIN_POINTS = 12
"""Fewer points of a beam say nothing."""

LEAST_SPEED_MPS, LEAST_SWEEP_S = 2.0, 0.02
"""Slower vehicles and shorter sweeps are hardly compensated."""

RESTORED = 0.5
"""Points were compensated if undoing it leaves at most this share of the deviation from an even turn. See
docs/measured.md."""


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


FLAT, STEEP = 0.75, 0.95
"""The sine of the elevations of a LiDAR about its axis of rotation stays below the first, in 99 % of its points; about
every other axis it exceeds the second."""


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
