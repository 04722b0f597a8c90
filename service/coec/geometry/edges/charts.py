"""How significantly range edges fall on image edges at very many poses, spread evenly over a ball of rotations and a
ball of translations: most of the global search's work.

z = Σ w·e / √Σ w²

as in `alignment`, but on a chart: the edge map of an image, resampled onto the stereographic projection of the
directions about the optical axis. A point (x, y, z) lies at (x, y) / (|p| + z) of the chart, for any lens and any field
of view, so that it costs one root and one division instead of a camera model. Strengths and weights are whole numbers,
whose sums do not depend on their order. So the loops may run in vector registers, and a replay is exact to the bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera
from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID
from coec.geometry.points import thinned
from coec.geometry.projection import NOT_IN_IMAGE, exact_pixel, unproject

CELLS_PER_BLUR = 2.5
"""Cells of a chart per standard deviation of the blur; then the nearest cell is as good as interpolation."""

WEIGHT_STEPS = 64
"""Whole steps per unit of weight. With 127 steps of strength and a weight of √3, sums of 150,000 points fit 31 bits."""

MAX_CHART_POINTS = 150_000
"""Most points of a chart, so that its sums fit 31 bits."""

CELLS_PER_WORD = 4
"""Cells are read in words of 32 bits, because a processor gathers sixteen words at a time, but no bytes."""

MAX_FIELD_RAD = math.radians(110.0)
"""Largest half field of view of a chart: no lens sees beyond it."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeCharts:
    """Range edges and charted edge maps of the frames of a window, at one blur.

    Attributes:
        cells: (1 + F·height·width,) int8, and up to three more that fill the last word; strengths as in `EdgePyramid`,
            `VOID` if the image shows nothing there. Cell 0 stands for everything outside of the charts.
        size: height and width of one frame's chart.
        cells_per_unit: cells per unit of the stereographic plane.
        centre: (2,) float32, column and row of the optical axis.
        xyz_m: (3, E) float32 LiDAR frame, motion-compensated.
        weight: (E,) int32, in steps.
        first_cell: (E,) int32, where the chart of the point's frame begins.
    """

    cells: NDArray[np.int8]
    size: tuple[int, int]
    cells_per_unit: float
    centre: NDArray[np.float32]
    xyz_m: NDArray[np.float32]
    weight: NDArray[np.int32]
    first_cell: NDArray[np.int32]

    @property
    def frame(self) -> NDArray[np.int64]:
        """(E,) the frame of each point."""
        return (self.first_cell.astype(np.int64) - 1) // (self.size[0] * self.size[1])

    def of_points(self, index: NDArray[np.int64]) -> EdgeCharts:
        """The charts with only the range edges of the given indices."""
        xyz_m = np.ascontiguousarray(self.xyz_m[:, index])
        return replace(self, xyz_m=xyz_m, weight=self.weight[index], first_cell=self.first_cell[index])

    def at_most(self, points: int) -> EdgeCharts:
        """The charts with at most so many of the edges, each chosen with the same probability."""
        return self.of_points(thinned(len(self.weight), points))


def edge_charts(
    camera: Camera,
    maps: NDArray[np.int8],
    blur_rad: float,
    xyz_m: NDArray[np.float32],
    weight: NDArray[np.float32],
    frame: NDArray[np.int64],
) -> EdgeCharts:
    """Charts of the edge maps of a window.

    Args:
        camera: intrinsics at the resolution of the maps.
        maps: (F, h, w) int8, as in `EdgePyramid`.
        blur_rad: standard deviation of the blur of the maps, an angle about the optical axis.
        xyz_m: (3, E) float32 LiDAR frame; no more than `MAX_CHART_POINTS`.
        weight: (E,) float32, up to √3.
        frame: (E,) the frame of each point.

    Raises:
        ValueError: there are more points, so that their sums might not fit.
    """
    if xyz_m.shape[1] > MAX_CHART_POINTS:
        raise ValueError(f"a chart holds up to {MAX_CHART_POINTS} points, got {xyz_m.shape[1]}: thin them")
    unit = 2.0 * CELLS_PER_BLUR / blur_rad  # near the axis the stereographic plane halves angles
    low, high = _extent(camera)
    width, height = (np.ceil((high - low) * unit).astype(np.int64) + 1).tolist()
    centre = (-low * unit).astype(np.float32)
    return EdgeCharts(
        cells=_cells(maps.reshape(len(maps), -1), _pixels(camera, height, width, unit, centre)),
        size=(height, width),
        cells_per_unit=unit,
        centre=centre,
        xyz_m=np.ascontiguousarray(xyz_m, np.float32),
        weight=np.rint(weight * WEIGHT_STEPS).astype(np.int32),
        first_cell=(1 + frame * (height * width)).astype(np.int32),
    )


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _pixels(camera: Camera, height: int, width: int, unit: float, centre: NDArray[np.float32]) -> NDArray[np.int32]:
    """(height·width,) the pixel (row · columns + column) at the direction of each cell of a chart, or OUTSIDE."""
    pixel, here = np.empty(height * width, np.int32), np.eye(4)
    for row in prange(height):
        for column in range(width):
            x, y = (column - centre[0]) / unit, (row - centre[1]) / unit
            # The inverse of (x, y) / (1 + z) on the unit sphere.
            square = x * x + y * y
            pixel[row * width + column] = exact_pixel(camera, here, 2.0 * x, 2.0 * y, 1.0 - square)
    return pixel


@njit(cache=True, parallel=PRANGE)
def _cells(maps: NDArray[np.int8], pixel: NDArray[np.int32]) -> NDArray[np.int8]:
    """The cells of the charts of all maps (F, h·w), from the pixel of each cell of a chart."""
    per_chart = pixel.shape[0]
    cells = np.full(-(-(1 + maps.shape[0] * per_chart) // CELLS_PER_WORD) * CELLS_PER_WORD, VOID)
    for f in prange(maps.shape[0]):
        first = 1 + f * per_chart
        for i in range(per_chart):
            if pixel[i] != NOT_IN_IMAGE:
                cells[first + i] = maps[f, pixel[i]]
    return cells


def _extent(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (2,) of the part of the stereographic plane that the image covers."""
    columns, rows = np.linspace(0.0, camera.width - 1.0, 65), np.linspace(0.0, camera.height - 1.0, 65)
    rays, valid = unproject(camera, np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
    rays = rays[valid & (rays[:, 2] > math.cos(MAX_FIELD_RAD))]
    plane = rays[:, :2] / (1.0 + rays[:, 2:])
    # The margin of some cells covers what lies between the samples.
    return plane.min(axis=0) - 0.02, plane.max(axis=0) + 0.02


def charted_significances(charts: EdgeCharts, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """z at many poses (K, 4, 4): (K,)."""
    return _charted_z(*_arguments(charts), poses)


def pattern_search(
    charts: EdgeCharts,
    starts: NDArray[np.float64],
    steps: NDArray[np.float64],
    halvings: int,
    centre: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pattern search from many poses at once (Hooke and Jeeves 1961): it tries the axes in turn and halves the steps
    when none helps.

    Args:
        charts: edges and charts at one blur.
        starts: (K, 4, 4) poses.
        steps: (6,) first steps, radians and metres, about the camera axes; 0 leaves an axis alone.
        halvings: how often the steps are halved before the search ends.
        centre: (4, 4) pose about which the search is bounded.
        reach: (2,) largest rotation, radians, and translation, metres, from the centre; no step leaves it.

    Returns:
        Poses (K, 4, 4) and their z (K,).
    """
    ends, z = _pattern_search(
        *_arguments(charts), np.ascontiguousarray(starts), steps, halvings, np.ascontiguousarray(centre), reach
    )
    return ends, z


_Arguments = tuple[
    NDArray[np.int32], int, int, np.float32, NDArray[np.float32], NDArray[np.float32], NDArray[np.int32],
    NDArray[np.int32],
]  # fmt: skip


def _arguments(charts: EdgeCharts) -> _Arguments:
    height, width = charts.size
    return (
        charts.cells.view(np.int32), height, width, np.float32(charts.cells_per_unit), charts.centre, charts.xyz_m,
        charts.weight, charts.first_cell,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _charted_z_at(
    packed: NDArray[np.int32],
    height: int,
    width: int,
    unit: np.float32,
    centre: NDArray[np.float32],
    xyz: NDArray[np.float32],
    weight: NDArray[np.int32],
    first_cell: NDArray[np.int32],
    T: NDArray[np.float32],
    cell: NDArray[np.int32],
) -> float:
    """z at one pose (3, 4); `cell` (E,) is scratch."""
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    # Adding half a cell before truncation rounds to the nearest cell.
    half = np.float32(0.5)
    left, top = centre[0] + half, centre[1] + half
    right, bottom, stride, zero = np.float32(width), np.float32(height), np.int32(width), np.float32(0.0)
    for i in range(xyz.shape[1]):
        x, y, z = xyz[0, i], xyz[1, i], xyz[2, i]
        a = r00 * x + r01 * y + r02 * z + tx
        b = r10 * x + r11 * y + r12 * z + ty
        c = r20 * x + r21 * y + r22 * z + tz
        scale = unit / (np.sqrt(a * a + b * b + c * c) + c)
        u, v = a * scale + left, b * scale + top
        # Selections instead of branches, so that the loop runs in vector registers. Infinities and NaN compare false.
        inside = (u >= zero) & (u < right) & (v >= zero) & (v < bottom)
        column, row = np.int32(u if inside else zero), np.int32(v if inside else zero)
        cell[i] = first_cell[i] + row * stride + column if inside else np.int32(0)
    strength, square = np.int32(0), np.int32(0)
    for i in range(xyz.shape[1]):
        # Take the cell's byte out of its word (the first byte is the lowest): shift it to the top, then down with sign.
        place = np.uint32(cell[i])
        word = packed[np.uint64(place >> np.uint32(2))]
        e = np.int32(word << (np.int32(24) - np.int32((place & np.uint32(3)) << np.uint32(3)))) >> np.int32(24)
        w = weight[i] if e != VOID else np.int32(0)
        strength += w * e
        square += w * w
    # Both sums are in steps: the steps of weight cancel, those of strength are divided out.
    return strength / (STRENGTH_STEPS * math.sqrt(max(float(square), 1.0)))


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _charted_z(
    packed: NDArray[np.int32],
    height: int,
    width: int,
    unit: np.float32,
    centre: NDArray[np.float32],
    xyz: NDArray[np.float32],
    weight: NDArray[np.int32],
    first_cell: NDArray[np.int32],
    poses: NDArray[np.float64],
) -> NDArray[np.float64]:
    z = np.empty(poses.shape[0])
    for k in prange(poses.shape[0]):
        narrow, scratch = np.empty((3, 4), np.float32), np.empty(xyz.shape[1], np.int32)
        _narrow(poses[k], narrow)
        z[k] = _charted_z_at(packed, height, width, unit, centre, xyz, weight, first_cell, narrow, scratch)
    return z


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _pattern_search(
    packed: NDArray[np.int32],
    height: int,
    width: int,
    unit: np.float32,
    middle: NDArray[np.float32],
    xyz: NDArray[np.float32],
    weight: NDArray[np.int32],
    first_cell: NDArray[np.int32],
    starts: NDArray[np.float64],
    steps: NDArray[np.float64],
    halvings: int,
    centre: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    ends = starts.copy()
    scores = np.empty(starts.shape[0])
    for k in prange(starts.shape[0]):
        pose = starts[k].copy()
        narrow, scratch = np.empty((3, 4), np.float32), np.empty(xyz.shape[1], np.int32)
        _narrow(pose, narrow)
        best = _charted_z_at(packed, height, width, unit, middle, xyz, weight, first_cell, narrow, scratch)
        step = steps.copy()
        halved, axis, last, way = 0, 0, -1, 0.0
        # Axes in a row that did not help. After six of them there is nothing left to try with these steps. After five,
        # the sixth is the axis of the last step, and the way back along it is known to be worse.
        idle = 0
        for _ in range(6 * MAX_SWEEPS):
            idle += 1
            for sign in (-1.0, 1.0):
                if step[axis] == 0.0 or (idle == 6 and axis == last and sign == -way):
                    continue
                trial = _moved(pose, axis, sign * step[axis])
                if not _within(trial, centre, reach):
                    continue
                _narrow(trial, narrow)
                score = _charted_z_at(packed, height, width, unit, middle, xyz, weight, first_cell, narrow, scratch)
                if score > best:
                    best, pose, last, way, idle = score, trial, axis, sign, 0
                    break
            axis = (axis + 1) % 6
            if idle == 6:
                halved += 1
                if halved > halvings:
                    break
                for each in range(6):
                    step[each] *= 0.5
                idle, axis, last = 0, 0, -1
        scores[k] = best
        for i in range(3):
            for j in range(4):
                ends[k, i, j] = pose[i, j]
    return ends, scores


@njit(cache=True)
def _narrow(pose: NDArray[np.float64], out: NDArray[np.float32]) -> None:
    """Writes the upper rows of a pose (4, 4) in single precision into `out` (3, 4)."""
    for i in range(3):
        for j in range(4):
            out[i, j] = pose[i, j]


@njit(cache=True)
def _within(pose: NDArray[np.float64], centre: NDArray[np.float64], reach: NDArray[np.float64]) -> bool:
    """Whether pose · centre⁻¹ turns and shifts by no more than the reach."""
    # The trace of R·Cᵀ is the sum of the products of the entries; the shift is t - R·(Cᵀ·c).
    trace, shift2 = 0.0, 0.0
    for i in range(3):
        moved = 0.0
        for j in range(3):
            trace += pose[i, j] * centre[i, j]
            moved += pose[i, j] * (
                centre[0, j] * centre[0, 3] + centre[1, j] * centre[1, 3] + centre[2, j] * centre[2, 3]
            )
        shift2 += (pose[i, 3] - moved) ** 2
    # A micrometre of tolerance: if no translation is searched, rounding must not stop the rotation.
    return bool(trace >= 1.0 + 2.0 * math.cos(min(reach[0], math.pi)) and shift2 <= (reach[1] + 1e-6) ** 2)


MAX_SWEEPS = 40
"""Most sweeps of one climb over the axes; a basin is some ten steps wide."""


@njit(cache=True)
def _moved(pose: NDArray[np.float64], axis: int, amount: float) -> NDArray[np.float64]:
    """The pose perturbed on the left along one axis of [rx ry rz tx ty tz]."""
    out = pose.copy()
    if axis >= 3:
        out[axis - 3, 3] += amount
        return out
    a, b = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(amount), np.sin(amount)
    for j in range(4):
        out[a, j] = c * pose[a, j] - s * pose[b, j]
        out[b, j] = s * pose[a, j] + c * pose[b, j]
    return out


@njit(cache=True)
def select_separated(
    poses: NDArray[np.float64], order: NDArray[np.int64], count: int, limit: float
) -> NDArray[np.int64]:
    """The first `count` indices of `order` whose poses (K, 4, 4) lie apart in rotation: for any two of them the trace
    of R_a·R_bᵀ is at most `limit`. The trace is 1 + 2 cos(angle), and the sum of the products of the entries."""
    selected = np.empty(min(count, order.shape[0]), np.int64)
    number = 0
    for index in order:
        free = True
        for k in range(number):
            trace = 0.0
            for i in range(3):
                for j in range(3):
                    trace += poses[index, i, j] * poses[selected[k], i, j]
            if trace > limit:
                free = False
                break
        if free:
            selected[number] = index
            number += 1
            if number == selected.shape[0]:
                break
    return selected[:number]


_RATIO = 1.2207440846057596
"""The real root of x⁴ = x + 1."""

_STEPS = ((1.0 / _RATIO) ** 1, (1.0 / _RATIO) ** 2, (1.0 / _RATIO) ** 3)
"""Step of the R₃ sequence along each side of the unit cube."""


@njit(cache=True)
def unit_ball(count: int) -> NDArray[np.float64]:
    """(count, 3) points of the unit ball: the R₃ sequence (Roberts 2018, "The unreasonable effectiveness of quasirandom
    sequences") in the cube around it, without the points outside of the ball."""
    ball, accepted, number = np.empty((count, 3)), 0, 0
    while accepted < count:
        number += 1
        x, y, z = number * _STEPS[0] + 0.5, number * _STEPS[1] + 0.5, number * _STEPS[2] + 0.5
        x, y, z = 2.0 * (x - np.floor(x)) - 1.0, 2.0 * (y - np.floor(y)) - 1.0, 2.0 * (z - np.floor(z)) - 1.0
        if x * x + y * y + z * z <= 1.0:
            ball[accepted, 0], ball[accepted, 1], ball[accepted, 2] = x, y, z
            accepted += 1
    return ball


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def moved_by(
    pose: NDArray[np.float64], turn_rad: NDArray[np.float64], shift_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(K, 4, 4): a pose (4, 4), turned by rotation vectors (K, 3) and then shifted by (K, 3), on the left."""
    moved = np.zeros((turn_rad.shape[0], 4, 4))
    for k in prange(turn_rad.shape[0]):
        a, b, c = turn_rad[k]
        angle = math.sqrt(a * a + b * b + c * c)
        # Rodrigues' formula with half angles; for a zero turn, sin(angle/2)/angle is its limit 1/2.
        half, of_half = 0.5, math.cos(0.5 * angle)
        if angle > 0.0:
            half = math.sin(0.5 * angle) / angle
        by_axis, by_square = 2.0 * half * of_half, 2.0 * half * half
        cosine = 1.0 - by_square * angle * angle
        R = np.empty((3, 3))
        R[0, 0], R[1, 1], R[2, 2] = cosine + by_square * a * a, cosine + by_square * b * b, cosine + by_square * c * c
        R[0, 1], R[1, 0] = by_square * a * b - by_axis * c, by_square * a * b + by_axis * c
        R[0, 2], R[2, 0] = by_square * a * c + by_axis * b, by_square * a * c - by_axis * b
        R[1, 2], R[2, 1] = by_square * b * c - by_axis * a, by_square * b * c + by_axis * a
        for i in range(3):
            for j in range(4):
                moved[k, i, j] = R[i, 0] * pose[0, j] + R[i, 1] * pose[1, j] + R[i, 2] * pose[2, j]
            moved[k, i, 3] += shift_m[k, i]
        moved[k, 3, 3] = 1.0
    return moved
