"""Where a sweep jumps from a near surface to a far one: the points whose image should lie on an image edge.

Every point is compared with its two neighbours along the scan line, which are found without knowing the sensor: points
are sorted by row (the ring where the cloud has one, else a band of elevation) and azimuth, and within a band only
points of nearly the same elevation are neighbours. So organised, unorganised, 16- and 128-beam clouds are all treated
alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import njit
from coec.geometry.vectors import lengths

BAND_RAD = math.radians(0.42)
"""Height of a band of elevation where no ring is known: the beam spacing of a 64-beam sensor. Wider bands only cost
time, narrower ones cut scan lines of a tilted sensor into pieces."""

SAME_LINE_RAD = math.radians(0.15)
"""Largest difference of elevation between neighbours of a band: below half the spacing of common 64-beam sensors, so
that the ground, which differs from ring to ring, is no jump."""

NEIGHBOUR_RAD = math.radians(1.0)
"""Largest difference of azimuth between neighbours: five columns of a slow sensor; beyond lies a hole, not a
surface."""

LOOK_AHEAD = 6
"""Points of a band that are tried as the neighbour: some rings share a band."""

MIN_JUMP_M, MIN_JUMP_SHARE = 0.5, 0.05
"""A jump is at least so many metres, and so much of the nearer range: well above range noise, below the depth of a
car."""

MAX_WEIGHT_M = 3.0
"""Jumps of more metres weigh no more than this: a wall behind a pole proves as much at 5 m as at 50 m."""

MIN_RANGE_M = 2.0
"""Nearer points are the vehicle itself."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeEdges:
    """Points on the near side of a jump: `index` (E,) into the cloud, `weight` (E,) √(jump in metres), capped."""

    index: NDArray[np.int64]
    weight: NDArray[np.float32]


def range_edges(xyz_m: NDArray[np.float32], ring: NDArray[np.uint16] | None) -> RangeEdges:
    """The near sides of the range jumps of a sweep (METHOD, section 3, "Edge alignment").

    Args:
        xyz_m: (N, 3) float32, sensor frame, as measured (motion compensation would tear scan lines apart).
        ring: (N,) uint16 or None.
    """
    range_m = lengths(xyz_m)
    far = np.flatnonzero(range_m >= MIN_RANGE_M)
    xyz_m, range_m = xyz_m[far], range_m[far]
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
    elevation = np.arcsin(np.clip(xyz_m[:, 2] / np.maximum(range_m, MIN_RANGE_M), -1.0, 1.0))
    if ring is None:
        row, same_line = np.floor(elevation / BAND_RAD).astype(np.int64), SAME_LINE_RAD
    else:
        row, same_line = ring[far].astype(np.int64), math.pi
    order = np.lexsort((azimuth, row))
    index, weight = _jumps(row[order], azimuth[order], elevation[order], range_m[order], same_line)
    return RangeEdges(far[order[index]], weight)


@njit(cache=True)
def _jumps(
    row: NDArray[np.int64],
    azimuth: NDArray[np.float32],
    elevation: NDArray[np.float32],
    range_m: NDArray[np.float32],
    same_line: float,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Indices and weights of the near sides, over points sorted by row and azimuth."""
    count = row.shape[0]
    index = np.empty(count, np.int64)
    weight = np.empty(count, np.float32)
    found = 0
    for k in range(count):
        jump = 0.0
        for step in (-1, 1):
            for ahead in range(1, LOOK_AHEAD + 1):
                j = k + step * ahead
                if j < 0 or j >= count or row[j] != row[k] or abs(azimuth[j] - azimuth[k]) > NEIGHBOUR_RAD:
                    break
                if abs(elevation[j] - elevation[k]) < same_line:
                    jump = max(jump, range_m[j] - range_m[k])
                    break
        if jump > MIN_JUMP_M and jump > MIN_JUMP_SHARE * range_m[k]:
            index[found] = k
            weight[found] = math.sqrt(min(jump, MAX_WEIGHT_M))
            found += 1
    return index[:found].copy(), weight[:found].copy()
