"""Scan lines: the points of a sweep in the order in which a beam passes over the scene.

They are found without knowing the sensor: points are sorted by row (the ring if the cloud has one, else a band of
elevation) and azimuth, and within a band only points of nearly the same elevation are neighbours. So organised,
unorganised, 16- and 128-beam clouds are treated alike.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import njit
from coec.geometry.points import BAND_RAD, distinct_rings
from coec.geometry.sweep_kernels import Bearings, bearings

BANDS = math.ceil(0.5 * math.pi / BAND_RAD)
"""Bands of elevation in a quarter of a turn, from the horizon up or down."""

SAME_LINE_RAD = math.radians(0.15)
"""Largest difference of elevation between neighbours in a band. It is below half the spacing of common 64-beam sensors,
so that the ground, whose range differs from ring to ring, makes no jump."""

NEIGHBOUR_RAD = math.radians(1.0)
"""Largest difference of azimuth between neighbours: five columns of a slow sensor. A larger gap is a hole, not a
surface."""

MAX_NEIGHBOURS_TRIED = 6
"""Points of a band that are tried as the neighbour, because several rings may share a band."""

MIN_RANGE_M = 2.0
"""Nearer points are the vehicle itself."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanLines:
    """The points of a sweep, without those on the vehicle itself, by row and then by azimuth.

    Attributes:
        xyz_m: (N, 3) float32, all points as measured, sensor frame.
        order: (M,) int32 into these.
        first: (rows + 1,) int64, where each row begins in `order`.
        azimuth, range_m: (M,) float32 of each, rad and m.
        elevation: (M,) float32, rad; empty if every row is one scan line.
        same_line_rad: largest difference of elevation between neighbours.
    """

    xyz_m: NDArray[np.float32]
    order: NDArray[np.int32]
    first: NDArray[np.int64]
    azimuth: NDArray[np.float32]
    elevation: NDArray[np.float32]
    range_m: NDArray[np.float32]
    same_line_rad: float

    @property
    def one_line_per_row(self) -> bool:
        """Whether only the order of the points of a row counts, not their elevation."""
        return self.same_line_rad >= math.pi


@dataclass(frozen=True, slots=True, eq=False)
class SweepEdges:
    """Where edges of surfaces, or on surfaces, pass through a sweep.

    Attributes:
        index: (E,) into the cloud, the nearest point, on the near side of a range jump; its time is that of the edge.
        shift_m: (E, 3) float32, from that point to the edge, at the point's range.
        weight: (E,) float32, up to √3.
    """

    index: NDArray[np.int64]
    shift_m: NDArray[np.float32]
    weight: NDArray[np.float32]


def scan_lines(xyz_m: NDArray[np.float32], ring: NDArray[np.uint16] | None, seen: Bearings | None = None) -> ScanLines:
    """The scan lines of a sweep.

    Args:
        xyz_m: (N, 3) float32, sensor frame, as measured (motion compensation would tear scan lines apart).
        ring: (N,) uint16 or None.
        seen: the bearings of the points, if the caller has them.
    """
    seen = bearings(xyz_m) if seen is None else seen
    ring = distinct_rings(ring)
    if ring is None:
        # A point without an elevation (NaN) lands in the highest band, where it is near to no other.
        band = np.fmin(np.floor(seen.elevation / BAND_RAD), BANDS - 1)
        row, rows, same_line = (band + BANDS).astype(np.uint16), 2 * BANDS, SAME_LINE_RAD
    else:
        row, rows, same_line = ring, int(ring.max(initial=0)) + 1, math.pi
    # Always read-only, so that the kernel is compiled for one type of array only.
    row = np.ascontiguousarray(row).view()
    row.setflags(write=False)
    order, first, azimuth, elevation, range_m = _along_the_rows(
        row, rows, seen.azimuth, seen.elevation, seen.range_m, same_line >= math.pi
    )
    return ScanLines(xyz_m, order, first, azimuth, elevation, range_m, same_line)


def turned_about_the_axis(xyz_m: NDArray[np.float32], turn_rad: NDArray[np.float32]) -> NDArray[np.float32]:
    """(E, 3): how far points (E, 3) move when each is turned about the sensor's axis by its own angle."""
    sine, less = np.sin(turn_rad, dtype=np.float64), 1.0 - np.cos(turn_rad, dtype=np.float64)
    x_m, y_m = xyz_m[:, 0].astype(np.float64), xyz_m[:, 1].astype(np.float64)
    shift_m = np.zeros(xyz_m.shape, np.float32)
    shift_m[:, 0] = -x_m * less - y_m * sine
    shift_m[:, 1] = x_m * sine - y_m * less
    return shift_m


_Rows = tuple[
    NDArray[np.int32], NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]
]  # fmt: skip

_RISING, _TURNED, _FALLING, _MIXED = 0, 1, 2, 3
"""Order of the azimuths of a row: ascending; ascending, but begun in the middle of a turn; descending, begun anywhere;
or no order."""


@njit(cache=True)
def _along_the_rows(
    row: NDArray[np.uint16],
    rows: int,
    azimuth: NDArray[np.float32],
    elevation: NDArray[np.float32],
    range_m: NDArray[np.float32],
    one_line_per_row: bool,
) -> _Rows:
    """Sorts the points, without those on the vehicle itself, by row and then by azimuth; ties keep their order. Returns
    their indices; where each row begins, (rows + 1,); and their azimuth, elevation (empty if all points of a row count
    as `beside` each other) and range.

    A first pass examines the rows. In most sweeps they are ascending, descending, or begin in the middle of a turn, so
    that the second pass puts every point into its final place at once.
    """
    first, kind, fall, rise = _row_orders(row, rows, azimuth, range_m)
    order = np.empty(first[rows], np.int32)
    turned, far_m = np.empty(first[rows], np.float32), np.empty(first[rows], np.float32)
    raised = np.empty(0 if one_line_per_row else first[rows], np.float32)
    following = np.zeros(rows, np.int64)
    for i in range(row.shape[0]):
        if range_m[i] >= MIN_RANGE_M:
            r = row[i]
            k = at = following[r]
            following[r] = k + 1
            if kind[r] == _TURNED:
                at = k - fall[r] if k >= fall[r] else k + first[r + 1] - first[r] - fall[r]
            elif kind[r] == _FALLING:
                at = rise[r] - 1 - k if k < rise[r] else rise[r] + first[r + 1] - first[r] - 1 - k
            at += first[r]
            order[at], turned[at], far_m[at] = i, azimuth[i], range_m[i]
            if not one_line_per_row:
                raised[at] = elevation[i]
    for r in range(rows):
        if kind[r] == _MIXED:
            of_row = slice(first[r], first[r + 1])
            sequence = np.argsort(turned[of_row], kind="mergesort")
            _take(order[of_row], sequence)
            _take(turned[of_row], sequence)
            _take(far_m[of_row], sequence)
            if not one_line_per_row:
                _take(raised[of_row], sequence)
    return order, first, turned, raised, far_m


@njit(cache=True)
def _row_orders(
    row: NDArray[np.uint16], rows: int, azimuth: NDArray[np.float32], range_m: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Where each row begins (rows + 1,), and (rows,) the order of its azimuths and the places of its last fall and
    rise."""
    count, first_azimuth, latest = np.zeros(rows, np.int64), np.empty(rows, np.float32), np.empty(rows, np.float32)
    falls, rises = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
    fall, rise = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
    for i in range(row.shape[0]):
        if range_m[i] >= MIN_RANGE_M:
            r, angle = row[i], azimuth[i]
            if count[r] == 0:
                first_azimuth[r] = angle
            elif angle < latest[r]:
                falls[r], fall[r] = falls[r] + 1, count[r]
            elif angle > latest[r]:
                rises[r], rise[r] = rises[r] + 1, count[r]
            latest[r] = angle
            count[r] += 1
    first, kind = np.zeros(rows + 1, np.int64), np.full(rows, _MIXED)
    for r in range(rows):
        first[r + 1] = first[r] + count[r]
        if falls[r] == 0:
            kind[r] = _RISING
        elif falls[r] == 1 and latest[r] < first_azimuth[r]:
            kind[r] = _TURNED
        elif rises[r] == 0 or (rises[r] == 1 and latest[r] > first_azimuth[r]):  # the sensor turns clockwise
            kind[r] = _FALLING
    return first, kind, fall, rise


@njit(cache=True)
def _take(values: NDArray[Any], sequence: NDArray[np.int64]) -> None:
    """Reorders values (n,) in place."""
    before = values.copy()
    for i in range(sequence.shape[0]):
        values[i] = before[sequence[i]]
