"""Where a sweep jumps from a near surface to a far one: the points whose image should lie on an image edge.

Every point is compared with its two neighbours along the scan line, which are found without knowing the sensor: points
are sorted by row (the ring where the cloud has one, else a band of elevation) and azimuth, and within a band only
points of nearly the same elevation are neighbours. So organised, unorganised, 16- and 128-beam clouds are all treated
alike.

The silhouette passes between the last beam that came back from the near surface and the first that went by: half a
spacing outside of the last near point, wherever that happened to lie. A beam is a cone, though, and comes back from the
near surface as soon as some of it falls there: that half is less by what spills over (`SPILL_RAD`). Where beams lie too
far apart for that (`WIDE_RAD`), the last near point stands for the edge. What both neighbours of a point lie behind is
thinner than two spacings: one edge, a ridge, at the point itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import njit, prange
from coec.geometry.vectors import lengths

BAND_RAD = math.radians(0.42)
"""Height of a band of elevation where no ring is known: the beam spacing of a 64-beam sensor. Wider bands only cost
time, narrower ones cut scan lines of a tilted sensor into pieces."""

BANDS = math.ceil(0.5 * math.pi / BAND_RAD)
"""Of a quarter of a turn, from the horizon up or down."""

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

SPILL_RAD = math.radians(0.06)
"""How far the axis of a beam passes a near surface that it still measures: the half angle of a beam of 2 mrad (data
sheets of spinning sensors: 2 to 3 mrad in all). Of two echoes the stronger one counts, and that of the nearer surface
is the stronger one with little of the beam."""

WIDE_RAD = math.radians(0.25)
"""Beams farther apart than this tell nothing of where between them a silhouette passes: either a return is missing, or
the sensor has few columns and gathers light over all of each, so that near surfaces grow by half a column (an OS1 of
1024 columns, 0.35° apart: half a column farther out, other poses fit its garage nearly as well as the true one)."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeEdges:
    """Where the silhouettes of near surfaces pass.

    Attributes:
        index: (E,) into the cloud, the point on the near side: when the edge was measured.
        shift_m: (E, 3) float32, from that point to the edge, at the point's range.
        weight: (E,) float32, √(jump in metres), capped.
    """

    index: NDArray[np.int64]
    shift_m: NDArray[np.float32]
    weight: NDArray[np.float32]


def range_edges(xyz_m: NDArray[np.float32], ring: NDArray[np.uint16] | None) -> RangeEdges:
    """The silhouettes that the range jumps of a sweep tell (METHOD, section 3, "Edge alignment").

    Args:
        xyz_m: (N, 3) float32, sensor frame, as measured (motion compensation would tear scan lines apart).
        ring: (N,) uint16 or None.
    """
    range_m = lengths(xyz_m)
    far = np.flatnonzero(range_m >= MIN_RANGE_M)
    kept_m, range_m = xyz_m[far], range_m[far]
    azimuth = np.arctan2(kept_m[:, 1], kept_m[:, 0])
    elevation = np.arcsin(np.clip(kept_m[:, 2] / np.maximum(range_m, MIN_RANGE_M), -1.0, 1.0))
    if ring is None or (len(ring) and ring.min() == ring.max()):  # one number for all beams tells none from another
        # A point without an elevation lands in the highest band: it is near to none there.
        band = np.fmin(np.floor(elevation / BAND_RAD), BANDS - 1)
        row, rows, same_line = (band + BANDS).astype(np.uint16), 2 * BANDS, SAME_LINE_RAD
    else:
        row, rows, same_line = ring[far], int(ring.max(initial=0)) + 1, math.pi
    order = _along_the_rows(row, rows, azimuth)
    index, turn_rad, weight = _jumps(row[order], azimuth[order], elevation[order], range_m[order], same_line)
    near = far[order[index]]
    return RangeEdges(near, _about_the_axis(kept_m[order[index]], turn_rad), weight)


@njit(cache=True, parallel=True)
def _along_the_rows(row: NDArray[np.uint16], rows: int, azimuth: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices that bring points into order of their row, and within a row of their azimuth; else as they were.

    Counted into their rows first: those of most sweeps are in order then, or begin in the middle of a turn.
    """
    first = np.zeros(rows + 1, np.int64)
    for k in row:
        first[k + 1] += 1
    for k in range(rows):
        first[k + 1] += first[k]
    order, following = np.empty(row.shape[0], np.int64), first[:-1].copy()
    for i in range(row.shape[0]):
        order[following[row[i]]] = i
        following[row[i]] += 1
    for k in prange(rows):
        of_row = order[first[k] : first[k + 1]]
        count, descents, cut = of_row.shape[0], 0, 0
        for i in range(1, count):
            if azimuth[of_row[i]] < azimuth[of_row[i - 1]]:
                descents, cut = descents + 1, i
        if descents == 1 and azimuth[of_row[count - 1]] < azimuth[of_row[0]]:
            turned = of_row.copy()
            of_row[: count - cut], of_row[count - cut :] = turned[cut:], turned[:cut]
        elif descents > 0:
            of_row[:] = of_row[np.argsort(azimuth[of_row], kind="mergesort")]
    return order


@njit(cache=True)
def _jumps(
    row: NDArray[np.uint16],
    azimuth: NDArray[np.float32],
    elevation: NDArray[np.float32],
    range_m: NDArray[np.float32],
    same_line: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float32]]:
    """Indices of the near sides, the azimuth from there to the edge, and weights; over points sorted by row and
    azimuth."""
    count = row.shape[0]
    index = np.empty(count, np.int64)
    turn_rad = np.empty(count, np.float64)
    weight = np.empty(count, np.float32)
    found = 0
    for k in range(count):
        least = max(MIN_JUMP_M, MIN_JUMP_SHARE * range_m[k])
        highest, sides, turn = 0.0, 0, 0.0
        for step in (-1, 1):
            for ahead in range(1, LOOK_AHEAD + 1):
                j = k + step * ahead
                if j < 0 or j >= count or row[j] != row[k] or abs(azimuth[j] - azimuth[k]) > NEIGHBOUR_RAD:
                    break
                if abs(elevation[j] - elevation[k]) < same_line:
                    jump = range_m[j] - range_m[k]
                    if jump > least:
                        highest = max(highest, jump)
                        sides += 1
                        gap = abs(azimuth[j] - azimuth[k])
                        turn = step * (0.5 * gap - SPILL_RAD) if gap <= WIDE_RAD else 0.0
                    break
        if sides > 0:
            index[found] = k
            turn_rad[found] = turn if sides == 1 else 0.0
            weight[found] = math.sqrt(min(highest, MAX_WEIGHT_M))
            found += 1
    return index[:found].copy(), turn_rad[:found].copy(), weight[:found].copy()


def _about_the_axis(xyz_m: NDArray[np.float32], turn_rad: NDArray[np.float64]) -> NDArray[np.float32]:
    """(E, 3) by how much points (E, 3) move when they are turned about the sensor's axis, each by its own angle."""
    sine, less = np.sin(turn_rad), 1.0 - np.cos(turn_rad)
    x_m, y_m = xyz_m[:, 0].astype(np.float64), xyz_m[:, 1].astype(np.float64)
    shift_m = np.zeros(xyz_m.shape, np.float32)
    shift_m[:, 0] = -x_m * less - y_m * sine
    shift_m[:, 1] = x_m * sine - y_m * less
    return shift_m
