"""Where a cloud's points were measured from.

Drivers often hand out clouds in the vehicle's frame. Directions and ranges, and with them every range edge, then start
from a place where no sensor is. `from_origin` undoes that with the LiDAR's stated pose in the cloud's frame;
`apparent_origin` tells a statement that the points contradict.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import LidarFrame, Matrix4

Doubles = NDArray[np.float64]

POINTS = 6000
"""Looked at, evenly chosen: some hundred a ring of a 64-beam sensor."""

NEAR_M, FAR_M = 2.0, 40.0
"""Ranges looked at. Nearer, the lasers' own places in the sensor tell; farther, half a metre turns a ray by less than a
beam's width."""

MIN_RINGS, MIN_POINTS = 4, 12
"""Fewer rings, or points of a ring, say nothing."""

STEPS, STEP = 16, 1e-3
"""Of the search, and of its differences: metres, and slopes of the axis."""

LONGEST = np.array([1.0, 1.0, 1.0, 0.2, 0.2])
"""Step of the search: metres, and slopes of the axis."""

NORMAL = 1.4826
"""Standard deviation of a normal distribution, in medians of its absolute deviations."""

CONTRADICTED_RAD, EXPLAINED = math.radians(0.5), 0.25
"""Spread of a ring's elevations at the stated origin above which it cannot be that: twice what a beam and an
uncompensated metre of driving leave. And the share of it that may remain where the points come from."""

GIVE_UP = 5
"""Sweeps in a row that no cones explain, after which the LiDAR is taken for one without."""

APART_M = 0.3
"""Origins nearer to each other than that are one: a sensor's height."""


@dataclass(frozen=True, slots=True)
class ApparentOrigin:
    """A place from which the points of a cloud look measured, and the stated one does not.

    Attributes:
        origin_m: (3,) of the LiDAR, in the frame in which the points were taken to be.
        spread_rad, stated_rad: of the elevations within a ring seen from there, and from the stated origin.
    """

    origin_m: tuple[float, float, float]
    spread_rad: float
    stated_rad: float

    @property
    def sentence(self) -> str:
        """For people."""
        place = ", ".join(f"{value:+.2f}" for value in self.origin_m)
        return f"The points contradict their origin: they look measured from ({place}) m of their frame."


def from_origin(sweep: LidarFrame, T_cloud_lidar: Matrix4, frame_id: str) -> LidarFrame:
    """A sweep in the LiDAR's own frame, of that name: its points were given in a frame in which the LiDAR has the pose
    T_cloud_lidar (4, 4), metres. The identity leaves the points as they are, to the bit."""
    if np.array_equal(T_cloud_lidar, np.eye(4)):
        return replace(sweep, frame_id=frame_id)
    R, t = T_cloud_lidar[:3, :3], T_cloud_lidar[:3, 3]
    xyz_m = ((sweep.xyz_m.astype(np.float64) - t) @ R).astype(np.float32)
    return replace(sweep, frame_id=frame_id, xyz_m=xyz_m)


def apparent_origin(sweep: LidarFrame) -> ApparentOrigin | None:
    """Where the points contradict that they were measured from the origin of their frame, from where they look
    measured; None where they do not, or where nothing is known. See `OriginCheck`."""
    return OriginCheck().look(sweep)


class OriginCheck:
    """Looks at the sweeps of one LiDAR, one after the other.

    A laser of a turning LiDAR has one elevation, seen from the sensor: its points lie on a cone about the sensor's
    axis. From elsewhere they do not. So rings are needed; and where no cones explain them (another scanning pattern, a
    `ring` that numbers something else), nothing is known, and after a few such sweeps nothing more is tried.
    """

    def __init__(self) -> None:
        self._cones: Doubles | None = None
        self._unexplained = 0

    def look(self, sweep: LidarFrame) -> ApparentOrigin | None:
        """From where the points of a sweep look measured, if they contradict their origin."""
        rings = None if self._unexplained >= GIVE_UP else _rings(sweep)
        if rings is None:
            return None
        stated_rad = _spread_rad(*rings, np.zeros(5))
        if stated_rad <= CONTRADICTED_RAD:
            return None
        # What explained the sweep before usually explains this one.
        if self._cones is None or _spread_rad(*rings, self._cones) > EXPLAINED * stated_rad:
            self._cones = _sharpest(*rings)
        spread_rad = _spread_rad(*rings, self._cones)
        if spread_rad > EXPLAINED * stated_rad:
            self._cones = None
            self._unexplained += 1
            return None
        self._unexplained = 0
        x, y, z = self._cones[:3].tolist()
        return ApparentOrigin((x, y, z), spread_rad, stated_rad) if math.hypot(x, y, z) >= APART_M else None


def _rings(sweep: LidarFrame) -> tuple[Doubles, NDArray[np.int64]] | None:
    """Points (N, 3) at middle ranges, and the number of each one's ring, counted from 0; None where there are too few
    of either."""
    if sweep.ring is None:
        return None
    stride = max(1, len(sweep.xyz_m) // POINTS)
    xyz_m, ring = sweep.xyz_m[::stride].astype(np.float64), sweep.ring[::stride]
    range_m = np.sqrt((xyz_m**2).sum(axis=1))
    # Measured from the stated origin, which may be the wrong one: generous on both sides.
    inside = (range_m > NEAR_M) & (range_m < FAR_M)
    xyz_m, ring = xyz_m[inside], ring[inside]
    _, number, count = np.unique(ring, return_inverse=True, return_counts=True)
    full = count >= MIN_POINTS
    if full.sum() < MIN_RINGS:
        return None
    keep = full[number]
    renumbered = np.cumsum(full) - 1
    return xyz_m[keep], renumbered[number[keep]]


# Cones are described by their tip (x, y, z; metres) and the slope of their axis (x, y; per metre of height): (5,).


def _elevation_rad(xyz_m: Doubles, cones: Doubles) -> Doubles:
    axis = np.array([cones[3], cones[4], 1.0]) / math.sqrt(1.0 + float(cones[3] ** 2 + cones[4] ** 2))
    ray_m = xyz_m - cones[:3]
    along_m = ray_m @ axis
    across_m = np.sqrt(np.maximum((ray_m**2).sum(axis=1) - along_m**2, 0.0))
    return np.asarray(np.arctan2(along_m, across_m))


def _deviations_rad(xyz_m: Doubles, ring: NDArray[np.int64], cones: Doubles) -> Doubles:
    """Of each point's elevation from the median of its ring's."""
    elevation_rad = _elevation_rad(xyz_m, cones)
    order = np.lexsort((elevation_rad, ring))
    begins = np.searchsorted(ring[order], np.arange(ring.max() + 2))
    medians = elevation_rad[order][(begins[:-1] + begins[1:]) // 2]
    return np.asarray(elevation_rad - medians[ring])


def _spread_rad(xyz_m: Doubles, ring: NDArray[np.int64], cones: Doubles) -> float:
    """Typical deviation, as the standard deviation of a normal distribution with the same median."""
    return NORMAL * float(np.median(np.abs(_deviations_rad(xyz_m, ring, cones))))


def _sharpest(xyz_m: Doubles, ring: NDArray[np.int64]) -> Doubles:
    """The cones (5,) that are thinnest: Gauss-Newton on the deviations, those beyond three times the typical one left
    out (people beside a ring, reflections)."""
    cones = np.zeros(5)
    for _ in range(STEPS):
        deviation = _deviations_rad(xyz_m, ring, cones)
        kept = np.abs(deviation) <= 3 * NORMAL * np.median(np.abs(deviation))
        slopes = np.stack([_slope(xyz_m, ring, cones, step) for step in STEP * np.eye(5)], axis=1)
        change = np.linalg.lstsq(slopes[kept], -deviation[kept], rcond=1e-6)[0]
        cones = cones + np.clip(change, -LONGEST, LONGEST)
        if float(np.linalg.norm(change)) < STEP:
            break
    return cones


def _slope(xyz_m: Doubles, ring: NDArray[np.int64], cones: Doubles, step: Doubles) -> Doubles:
    ahead, behind = (_deviations_rad(xyz_m, ring, cones + sign * step) for sign in (1.0, -1.0))
    return np.asarray((ahead - behind) / (2 * STEP))
