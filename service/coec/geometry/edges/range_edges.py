"""Range edges: where a sweep jumps from a near surface to a far one. Their image should lie on an image edge.

Every point is compared with its two neighbours along the scan line.

The silhouette passes between the last beam that came back from the near surface and the first that missed it: on
average half a spacing outside of the last near point. A beam is a cone, though, and comes back from the near surface as
soon as some of it falls there, so that the half spacing is reduced by this spill (`SPILL_RAD`). If beams lie too far
apart for that (`WIDE_RAD`), the last near point stands for the edge. If both neighbours of a point lie behind it, the
object is thinner than two spacings and makes one edge, a ridge, at the point itself.
"""

import math

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.edges.scan_lines import (
    MAX_NEIGHBOURS_TRIED,
    NEIGHBOUR_RAD,
    ScanLines,
    SweepEdges,
    turned_about_the_axis,
)

MIN_JUMP_M, MIN_JUMP_SHARE = 0.5, 0.05
"""Least jump, in metres and as a share of the nearer range; well above range noise and below the depth of a car."""

MAX_WEIGHT_M = 3.0
"""Larger jumps weigh no more than this one: a wall behind a pole proves as much at 5 m as at 50 m."""

SPILL_RAD = math.radians(0.06)
"""How far the axis of a beam can pass beside a near surface that it still measures: the half angle of a beam of 2 mrad
(data sheets of spinning sensors: 2 to 3 mrad in all). The stronger of two echoes counts, and the nearer surface gives
the stronger echo even with a small part of the beam."""

WIDE_RAD = math.radians(0.25)
"""Beams farther apart than this do not tell where between them a silhouette passes. Either a return is missing, or the
sensor has few columns and gathers light over the whole column, so that near surfaces grow by half a column. See
docs/measured.md."""


def range_edges(lines: ScanLines) -> SweepEdges:
    """The silhouettes at the range jumps of a sweep (METHOD, section 3, "Edge alignment"); the weight of each is
    √(jump in metres), capped."""
    index, turn_rad, weight = _jumps(
        lines.first, lines.azimuth, lines.elevation, lines.range_m, lines.same_line_rad, lines.one_line_per_row
    )
    near_side = lines.order[index].astype(np.int64)
    return SweepEdges(near_side, turned_about_the_axis(lines.xyz_m[near_side], turn_rad), weight)


@njit(cache=True, parallel=PRANGE)
def _jumps(
    first: NDArray[np.int64],
    azimuth: NDArray[np.float32],
    elevation: NDArray[np.float32],
    range_m: NDArray[np.float32],
    same_line: float,
    one_line_per_row: bool,
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Positions of the near sides, azimuths from there to the edge, and weights, for points (N,) in the order of
    `_along_the_rows`."""
    rows, count = first.shape[0] - 1, azimuth.shape[0]
    index, turn_rad = np.empty(count, np.int32), np.empty(count, np.float32)
    weight, jumps_in_row = np.empty(count, np.float32), np.zeros(rows, np.int64)
    for r in prange(rows):
        begin, end = first[r], first[r + 1]
        at = begin
        for k in range(begin, end):
            if one_line_per_row:  # quick test: skip a point without a farther neighbour
                before = range_m[k - 1] if k > begin else np.float32(0.0)
                behind = range_m[k + 1] if k + 1 < end else np.float32(0.0)
                if (before if before > behind else behind) - range_m[k] <= MIN_JUMP_M:
                    continue
            least = max(MIN_JUMP_M, MIN_JUMP_SHARE * range_m[k])
            highest, sides, turn = 0.0, 0, 0.0
            for step in (-1, 1):
                for ahead in range(1, MAX_NEIGHBOURS_TRIED + 1):
                    j = k + step * ahead
                    if j < begin or j >= end or abs(azimuth[j] - azimuth[k]) > NEIGHBOUR_RAD:
                        break
                    if one_line_per_row or abs(elevation[j] - elevation[k]) < same_line:
                        jump = range_m[j] - range_m[k]
                        if jump > least:
                            highest = max(highest, jump)
                            sides += 1
                            gap = abs(azimuth[j] - azimuth[k])
                            turn = step * (0.5 * gap - SPILL_RAD) if gap <= WIDE_RAD else 0.0
                        break
            if sides > 0:
                index[at] = k
                turn_rad[at] = turn if sides == 1 else 0.0
                weight[at] = math.sqrt(min(highest, MAX_WEIGHT_M))
                at += 1
        jumps_in_row[r] = at - begin
    total, position = jumps_in_row.sum(), 0
    packed_index, packed_turn = np.empty(total, np.int32), np.empty(total, np.float32)
    packed_weight = np.empty(total, np.float32)
    for r in range(rows):
        for at in range(first[r], first[r] + jumps_in_row[r]):
            packed_index[position], packed_turn[position], packed_weight[position] = index[at], turn_rad[at], weight[at]
            position += 1
    return packed_index, packed_turn, packed_weight
