"""The centre line of a road that winds but never meets itself, and places beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Doubles = NDArray[np.float64]

STEP_M = 0.1
"""Spacing of the table of positions; between its entries the road is straight to 0.02 mm at the tightest bend."""
LONGEST_BEND_M, SHORTEST_BEND_M = 900.0, 260.0
"""Wavelengths of the heading. With `HEADING_RAD` the radius stays above 90 m, wider than the ground strip."""
HEADING_RAD = (0.30, 0.18, 0.10)
"""Amplitudes of the waves of the heading, radians. Their sum is below a right angle, so the road goes on in x."""
GRADE = (0.012, 0.008)
"""Amplitudes of the waves of the slope, metres per metre."""


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A road along arc length s, from `begin_m` on, at every `STEP_M`.

    Attributes:
        table: (K, 5): x, y, z in metres, heading and slope angle (positive uphill) in radians.
    """

    begin_m: float
    table: Doubles

    def at(self, s_m: ArrayLike) -> Doubles:
        """(..., 5) rows of the table at arc length s (held at its ends)."""
        place = (np.asarray(s_m, dtype=np.float64) - self.begin_m) / STEP_M
        place = np.clip(place, 0.0, len(self.table) - 1.000001)
        low = place.astype(np.int64)
        share = (place - low)[..., None]
        return (1 - share) * self.table[low] + share * self.table[low + 1]

    def points(self, s_m: ArrayLike, left_m: ArrayLike, up_m: ArrayLike) -> Doubles:
        """(..., 3) world points: along the road, to its left, above its surface."""
        s, left, up = np.broadcast_arrays(s_m, left_m, up_m)
        x, y, z, heading, _ = np.moveaxis(self.at(s), -1, 0)
        return np.stack([x - left * np.sin(heading), y + left * np.cos(heading), z + up], axis=-1)


def build_road(seed: int, begin_m: float, end_m: float, calmer: float = 1.0) -> Road:
    """The road of a seed between two arc lengths; its bends and slopes are `calmer` times longer."""
    rng = np.random.default_rng([seed, 100])
    s: Doubles = begin_m + STEP_M * np.arange(int(np.ceil((end_m - begin_m) / STEP_M)) + 2, dtype=np.float64)
    length = calmer * rng.uniform(SHORTEST_BEND_M, LONGEST_BEND_M, 3) * np.array([1.3, 1.0, 0.7])
    heading = _waves(rng, s, HEADING_RAD, length)
    slope = _waves(rng, s, GRADE, calmer * rng.uniform(150.0, 400.0, 2))
    middle = (heading[1:] + heading[:-1]) / 2
    flat = STEP_M * np.column_stack([np.cos(middle), np.sin(middle), (slope[1:] + slope[:-1]) / 2])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(flat, axis=0)])
    position -= position[int(-begin_m / STEP_M)]
    return Road(begin_m, np.column_stack([position, heading, np.arctan(slope)]))


def _waves(rng: np.random.Generator, s_m: Doubles, sizes: tuple[float, ...], lengths_m: Doubles) -> Doubles:
    total = np.zeros_like(s_m)
    for size, length_m in zip(sizes, lengths_m, strict=True):
        total += size * np.sin(2 * np.pi * s_m / length_m + rng.uniform(0, 2 * np.pi))
    return total
