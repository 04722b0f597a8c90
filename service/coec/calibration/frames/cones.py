"""The cones on which a turning LiDAR's points lie.

A laser of a turning LiDAR has one elevation, seen from the sensor: its points lie on a cone about the sensor's axis.
Cones are described by their tip (x, y, z; metres) and the slope of their axis (x, y; per metre of height): (5,).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

MIN_RINGS, MIN_POINTS = 4, 12
"""Fewer rings, or fewer points of a ring, say nothing."""

STEPS, STEP = 16, 1e-3
"""Most steps of the search, and its difference step: metres, and slopes of the axis."""

LONGEST = np.array([1.0, 1.0, 1.0, 0.2, 0.2])
"""Longest step of the search: metres, and slopes of the axis."""

NORMAL = 1.4826
"""Standard deviation of a normal distribution, in medians of its absolute deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Rings:
    """Points of rings that have enough of them.

    Attributes:
        xyz_m: (N, 3), in the order of the sweep.
        number: (N,) of each point's ring, counted from 0 without gaps.
        names: (R,) what the sensor calls these rings.
    """

    xyz_m: Doubles
    number: NDArray[np.int64]
    names: NDArray[np.int64]

    @classmethod
    def of(cls, xyz_m: Doubles, ring: NDArray[np.integer]) -> Rings | None:
        """The rings among points (N, 3) with the ring names of the sensor (N,); None if there are too few rings."""
        names, number, count = np.unique(ring, return_inverse=True, return_counts=True)
        full = count >= MIN_POINTS
        if full.sum() < MIN_RINGS:
            return None
        keep = full[number]
        renumbered = np.cumsum(full) - 1
        return cls(xyz_m[keep], renumbered[number[keep]], names[full].astype(np.int64))

    def part(self, begin: int, end: int) -> Rings | None:
        """The rings among the points from `begin` to before `end`."""
        return Rings.of(self.xyz_m[begin:end], self.names[self.number[begin:end]])

    def beams_rad(self, cones: Doubles) -> Doubles:
        """(R,) elevation of each ring: the median of its points."""
        return self._beams_rad(elevation_rad(self.xyz_m, cones))

    def deviations_rad(self, cones: Doubles) -> Doubles:
        """(N,) of each point's elevation from that of its ring."""
        seen_rad = elevation_rad(self.xyz_m, cones)
        return np.asarray(seen_rad - self._beams_rad(seen_rad)[self.number])

    def spread_rad(self, cones: Doubles) -> float:
        """The typical deviation, as the standard deviation of a normal distribution with the same median."""
        return NORMAL * float(np.median(np.abs(self.deviations_rad(cones))))

    def sharpest(self) -> Doubles:
        """The cones (5,) from which the points deviate least: Gauss-Newton on the deviations, without those beyond
        three times the typical one (people beside a ring, reflections)."""
        cones = np.zeros(5)
        for _ in range(STEPS):
            deviation = self.deviations_rad(cones)
            inliers = np.abs(deviation) <= 3 * NORMAL * np.median(np.abs(deviation))
            slopes = np.stack([self._slope(cones, step) for step in STEP * np.eye(5)], axis=1)
            change = np.linalg.lstsq(slopes[inliers], -deviation[inliers], rcond=1e-6)[0]
            cones = cones + np.clip(change, -LONGEST, LONGEST)
            if float(np.linalg.norm(change)) < STEP:
                break
        return cones

    def _slope(self, cones: Doubles, step: Doubles) -> Doubles:
        ahead, behind = (self.deviations_rad(cones + sign * step) for sign in (1.0, -1.0))
        return np.asarray((ahead - behind) / (2 * STEP))

    def _beams_rad(self, seen_rad: Doubles) -> Doubles:
        order = np.lexsort((seen_rad, self.number))
        begins = np.searchsorted(self.number[order], np.arange(len(self.names) + 1))
        return np.asarray(seen_rad[order][(begins[:-1] + begins[1:]) // 2])


def elevation_rad(xyz_m: Doubles, cones: Doubles) -> Doubles:
    """(N,) elevation of points (N, 3) above the plane through the tip of the cones and across their axis."""
    axis = np.array([cones[3], cones[4], 1.0]) / math.sqrt(1.0 + float(cones[3] ** 2 + cones[4] ** 2))
    ray_m = xyz_m - cones[:3]
    along_m = ray_m @ axis
    across_m = np.sqrt(np.maximum((ray_m**2).sum(axis=1) - along_m**2, 0.0))
    return np.asarray(np.arctan2(along_m, across_m))
