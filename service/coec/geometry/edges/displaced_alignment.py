"""The alignment of range edges with image edges while many parameters displace them: pose, clocks, lens.

The pixel of a range edge is linear in the parameters, u(x) = u₀ + J·x, so that the kernels need no camera model once
they have J, cost about as much for any number of parameters, and give the gradient with the value. Who calls them
linearises again where it ends.

Arrays have the edges last: blocks of `BLOCK` edges go through each step together, sixteen numbers to an instruction.
`CHUNK` edges are read from memory once for all points, and their sums are added in the order of the chunks, so that
results depend neither on the processor nor on the number of threads.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, project_point
from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.edges.alignment import LEAST_SQUARE, split_pixels
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID

BLOCK, CHUNK = 256, 1024

STEP = 1e-3
"""Difference step, as a share of the range by which a point is shifted: about a pixel or less."""

MARGIN = 0.25
"""Range edges are followed this share of an image beyond its border. Beside the camera they move by any number of
pixels for a small turn."""

OUT_OF_VIEW_PX = -1e6


@dataclass(frozen=True, slots=True, eq=False)
class DisplacedEdges:
    """Range edges on edge maps, as a linear function of n parameters.

    Attributes:
        uv_px: (2, E) float32 pixels at the point of linearisation.
        jacobian: (n, 2, E) float32 pixels per unit of each parameter.
        weight: (E,) float32.
        frame: (E,) int32 index of the map of each edge.
        maps: (F, h, w) int8, as in `EdgePyramid`.
    """

    uv_px: NDArray[np.float32]
    jacobian: NDArray[np.float32]
    weight: NDArray[np.float32]
    frame: NDArray[np.int32]
    maps: NDArray[np.int8]

    def significance(self, x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """z at the parameters x (n,), and its gradient (n,). What leaves the view does not count in the gradient."""
        z, gradients = of_sums(self._sums(np.zeros_like(x), x[None], 1, with_gradients=True))
        return float(z[0, 0]), gradients[0, 0]

    def significances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K,) z at K points (K, n), without gradients."""
        sums = self._sums(np.zeros_like(points[0]), points, 1, with_gradients=False)
        return np.asarray(of_sums(sums)[0][0])

    def gradients_across(
        self, centre: NDArray[np.float64], offsets: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(2, K) z at a point (n,) plus each of K offsets (K, n), and at the point minus each; and (2, K, n) its
        gradients."""
        return of_sums(self._sums(centre, offsets, 2, with_gradients=True))

    def cell_sums(
        self, cell: NDArray[np.int64], cells: int, points: NDArray[np.float64], along: int
    ) -> NDArray[np.float64]:
        """(K, cells, 2 + m): Σ w·e, Σ w², and the gradient of the first along the first m parameters (`along`), of the
        range edges of each cell at K points (K, n); `cell` (E,) is the cell of each."""
        return np.asarray(_sums_of_cells(*self._arguments, cell, cells, points.astype(np.float32), along))

    def _sums(
        self, centre: NDArray[np.float64], offsets: NDArray[np.float64], sides: int, *, with_gradients: bool
    ) -> NDArray[np.float64]:
        single = centre.astype(np.float32), offsets.astype(np.float32)
        of_chunks = _sums_at(*self._arguments, *single, sides, with_gradients)
        # One chunk after the other; NumPy would add pairs.
        return np.cumsum(of_chunks, axis=0)[-1] if len(of_chunks) else np.zeros(of_chunks.shape[1:])

    @property
    def _arguments(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int32], NDArray[np.int8]]:
        return self.uv_px, self.jacobian, self.weight, self.frame, self.maps


def of_sums(sums: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """z (...) and its gradients (..., n) from sums (..., 2 + n)."""
    root = np.sqrt(np.maximum(sums[..., 1], LEAST_SQUARE))
    return sums[..., 0] / root, sums[..., 2:] / root[..., None]


Scratch = tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int8]]


@njit(cache=True)
def _scratch() -> Scratch:
    """Memory for a block of edges: (4, BLOCK) and (BLOCK,) numbers, and (4, BLOCK) strengths."""
    return np.empty((4, BLOCK), np.float32), np.empty(BLOCK, np.int32), np.empty((4, BLOCK), np.int8)


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _sums_at(
    uv: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    weight: NDArray[np.float32],
    frame: NDArray[np.int32],
    maps: NDArray[np.int8],
    centre: NDArray[np.float32],
    offsets: NDArray[np.float32],
    sides: int,
    with_gradients: bool,
) -> NDArray[np.float64]:
    """(chunks, sides, K, 2 + n): Σ w·e, Σ w² and the gradient of the first (0 without) of each chunk of edges, at
    `centre` (n,) plus K offsets (K, n); on a second side at `centre` minus these."""
    edges, n = weight.shape[0], centre.shape[0]
    chunks = (edges + CHUNK - 1) // CHUNK
    sums = np.zeros((chunks, sides, offsets.shape[0], 2 + n))
    for chunk in prange(chunks):
        begin, scratch = chunk * CHUNK, _scratch()
        size = min(CHUNK, edges - begin)
        at, off = np.empty((2, size), np.float32), np.empty((2, size), np.float32)
        # One sum for each place in a block, so that they are added in vector registers.
        lanes = np.empty((sides, 2 + n, BLOCK), np.float32)
        at[:] = uv[:, begin : begin + size]
        _displace(at[0], at[1], jacobian, begin, centre)
        for k in range(offsets.shape[0]):
            off[:] = np.float32(0.0)
            lanes[:] = np.float32(0.0)
            _displace(off[0], off[1], jacobian, begin, offsets[k])
            for first in range(0, size, BLOCK):
                last = min(first + BLOCK, size)
                of_edges = slice(begin + first, begin + last)
                for side in range(sides):
                    u, v, strength, square = _rows(scratch, last - first)
                    sign = np.float32(1.0 - 2.0 * side)
                    _moved(at[0, first:last], off[0, first:last], sign, u)
                    _moved(at[1, first:last], off[1, first:last], sign, v)
                    _interpolate(u, v, weight[of_edges], frame[of_edges], maps, scratch, strength, square)
                    _add(strength, lanes[side, 0])
                    _add(square, lanes[side, 1])
                    if with_gradients:
                        for j in range(n):
                            _add_slopes(jacobian[j, 0, of_edges], jacobian[j, 1, of_edges], u, v, lanes[side, 2 + j])
            for side in range(sides):
                for j in range(2 + n):
                    sums[chunk, side, k, j] = _folded(lanes[side, j]) / (1.0 if j == 1 else STRENGTH_STEPS)
    return sums


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _sums_of_cells(
    uv: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    weight: NDArray[np.float32],
    frame: NDArray[np.int32],
    maps: NDArray[np.int8],
    cell: NDArray[np.int64],
    cells: int,
    points: NDArray[np.float32],
    along: int,
) -> NDArray[np.float64]:
    """(K, cells, 2 + m): Σ w·e, Σ w² and the gradient of the first along the first m parameters, of the edges of each
    cell at points (K, n)."""
    edges = weight.shape[0]
    sums = np.zeros((points.shape[0], cells, 2 + along))
    # With the parameters last they are added in vector registers; edges of a block belong to any cell.
    slopes = np.empty((edges, 2, along), np.float32)
    for j in range(along):
        slopes[:, :, j] = jacobian[j].T
    for k in prange(points.shape[0]):
        scratch, at = _scratch(), uv.copy()
        _displace(at[0], at[1], jacobian, 0, points[k])
        for first in range(0, edges, BLOCK):
            last = min(first + BLOCK, edges)
            _, _, strength, square = _rows(scratch, last - first)
            u, v = at[0, first:last], at[1, first:last]
            _interpolate(u, v, weight[first:last], frame[first:last], maps, scratch, strength, square)
            for i in range(last - first):
                of_cell = sums[k, cell[first + i]]
                of_cell[0] += strength[i]
                of_cell[1] += square[i]
                across, down = slopes[first + i, 0], slopes[first + i, 1]
                for j in range(along):
                    of_cell[2 + j] += u[i] * across[j] + v[i] * down[j]
        sums[k, :, 0] /= STRENGTH_STEPS
        sums[k, :, 2:] /= STRENGTH_STEPS
    return sums


@njit(cache=True)
def _rows(
    scratch: Scratch, count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Four rows (count,) of numbers, each in one piece, so that loops over them run in vector registers."""
    numbers = scratch[0]
    return numbers[0, :count], numbers[1, :count], numbers[2, :count], numbers[3, :count]


@njit(cache=True, error_model="numpy")
def _displace(
    u: NDArray[np.float32], v: NDArray[np.float32], jacobian: NDArray[np.float32], begin: int, x: NDArray[np.float32]
) -> None:
    """Moves the pixels (count,) of the edges from `begin` on by the parameters x (n,)."""
    end = begin + u.shape[0]
    for j in range(x.shape[0]):
        across, down, xj = jacobian[j, 0, begin:end], jacobian[j, 1, begin:end], x[j]
        if xj == 0.0:
            continue
        for i in range(u.shape[0]):
            u[i] += across[i] * xj
        for i in range(v.shape[0]):
            v[i] += down[i] * xj


@njit(cache=True)
def _moved(at: NDArray[np.float32], off: NDArray[np.float32], sign: np.float32, to: NDArray[np.float32]) -> None:
    for i in range(to.shape[0]):
        to[i] = at[i] + sign * off[i]


@njit(cache=True, error_model="numpy")
def _interpolate(
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    weight: NDArray[np.float32],
    frame: NDArray[np.int32],
    maps: NDArray[np.int8],
    scratch: Scratch,
    strength: NDArray[np.float32],
    square: NDArray[np.float32],
) -> None:
    """Writes w·e, in steps, and w² of edges (count,) at pixels (u, v), and in place of these the slopes of w·e across
    and down. Zero if one of the four pixels around does not count. Runs in passes: look-ups go edge by edge,
    calculations run in vector registers."""
    _, places, corners = scratch
    count, edges = u.shape[0], maps.ravel()
    height, width = maps.shape[1:]
    place = places[:count]
    split_pixels(width, height, u, v, place)
    p, q, r, s = corners[0, :count], corners[1, :count], corners[2, :count], corners[3, :count]
    whole, row, one = np.uint64(height * width), np.uint64(width), np.uint64(1)
    for i in range(count):
        here = np.uint64(frame[i]) * whole + np.uint64(max(place[i], 0))
        below = here + row
        p[i], q[i], r[i], s[i] = edges[here], edges[here + one], edges[below], edges[below + one]
    for i in range(count):
        seen = (place[i] >= 0) & (p[i] != VOID) & (q[i] != VOID) & (r[i] != VOID) & (s[i] != VOID)
        over, under = np.float32(q[i]) - np.float32(p[i]), np.float32(s[i]) - np.float32(r[i])
        upper, lower = np.float32(p[i]) + u[i] * over, np.float32(r[i]) + u[i] * under
        w = weight[i] if seen else np.float32(0.0)
        strength[i], square[i] = w * (upper + v[i] * (lower - upper)), w * w
        u[i], v[i] = w * (over + v[i] * (under - over)), w * (lower - upper)


@njit(cache=True)
def _add(values: NDArray[np.float32], lanes: NDArray[np.float32]) -> None:
    for i in range(values.shape[0]):
        lanes[i] += values[i]


@njit(cache=True, error_model="numpy")
def _add_slopes(
    of_u: NDArray[np.float32],
    of_v: NDArray[np.float32],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    lanes: NDArray[np.float32],
) -> None:
    """Adds what edges (count,) contribute to the gradient along a parameter, from how it moves their pixels."""
    for i in range(across.shape[0]):
        lanes[i] += across[i] * of_u[i] + down[i] * of_v[i]


@njit(cache=True)
def _folded(lanes: NDArray[np.float32]) -> float:
    """The sum of the lanes, halved until one is left."""
    width = BLOCK // 2
    while width > 0:
        for i in range(width):
            lanes[i] += lanes[width + i]
        width //= 2
    return float(lanes[0])


def linearised(
    camera: Camera,
    assumed: Camera,
    pose: NDArray[np.float64],
    shift_m: NDArray[np.float64],
    xyz_m: NDArray[np.float32],
    passing: NDArray[np.float32],
    share: NDArray[np.float32],
    clocks_s: NDArray[np.float64],
    radial: float,
    places: tuple[int, ...],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels (2, E) of points, and (n, 2, E) how they move with n places of a deviation (see
    `calibration.uncertainty.displaced_edges`). What is not within `MARGIN` of the image is `OUT_OF_VIEW_PX`, and does
    not move.

    Args:
        camera: with the deviation of its lens but for the radial term.
        assumed: without it: the lens is counted in its focal lengths.
        pose: (4, 4) T_camera_lidar, with its deviation.
        shift_m: (3,) by which `pose` shifts after it has turned.
        xyz_m: (3, E) LiDAR frame.
        passing: (3, E) velocity of standing things, m/s, LiDAR frame.
        share: (3, E) of the error of each clock.
        clocks_s: (3,) errors of the clocks.
        radial: share by which a corner of the image lies further out.
        places: n of 0 to 12.
    """
    points, of_places = np.ascontiguousarray(xyz_m), np.array(places, np.int64)
    return _linearised(
        camera, assumed.fx, assumed.fy, pose, shift_m, points, passing, share, clocks_s, radial, of_places
    )


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _linearised(
    camera: Camera,
    fx: float,
    fy: float,
    pose: NDArray[np.float64],
    shift_m: NDArray[np.float64],
    xyz_m: NDArray[np.float32],
    passing: NDArray[np.float32],
    share: NDArray[np.float32],
    clocks_s: NDArray[np.float64],
    radial: float,
    places: NDArray[np.int64],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    edges, n = xyz_m.shape[1], places.shape[0]
    uv, jacobian = np.empty((2, edges), np.float32), np.zeros((n, 2, edges), np.float32)
    square_px2 = 0.25 * (camera.width * camera.width + camera.height * camera.height)
    for blocks in prange((edges + BLOCK - 1) // BLOCK):
        p, passing_m, follows = np.empty(3), np.empty(3), np.empty((2, 3))
        for i in range(blocks * BLOCK, min((blocks + 1) * BLOCK, edges)):
            late_s = 0.0
            for k in range(3):
                late_s += clocks_s[k] * share[k, i]
            for row in range(3):
                p[row], passing_m[row] = pose[row, 3], 0.0
                for k in range(3):
                    p[row] += pose[row, k] * (xyz_m[k, i] + late_s * passing[k, i])
                    passing_m[row] += pose[row, k] * passing[k, i]
            u, v, seen = _projected(camera, p, follows)
            x, y = u - camera.cx, v - camera.cy
            if not (seen and _is_near(camera, u, v)):
                uv[0, i] = uv[1, i] = OUT_OF_VIEW_PX
                continue
            outward = (x * x + y * y) / square_px2
            uv[0, i], uv[1, i] = u + radial * outward * x, v + radial * outward * y
            for row in range(3):
                p[row] -= shift_m[row]
            for j in range(n):
                place = places[j]
                if place < 9:
                    by = _moved_by(place, p, passing_m, share, i)
                    for row in range(2):
                        jacobian[j, row, i] = (
                            follows[row, 0] * by[0] + follows[row, 1] * by[1] + follows[row, 2] * by[2]
                        )
                elif place == 9:
                    jacobian[j, 0, i] = fx
                elif place == 10:
                    jacobian[j, 1, i] = fy
                elif place == 11:
                    jacobian[j, 0, i], jacobian[j, 1, i] = x * fx / camera.fx, y * fy / camera.fy
                else:
                    jacobian[j, 0, i], jacobian[j, 1, i] = outward * x, outward * y
    return uv, jacobian


@njit(cache=True, error_model="numpy")
def _projected(camera: Camera, p: NDArray[np.float64], follows: NDArray[np.float64]) -> tuple[float, float, bool]:
    """The pixel of a point (3,), and whether it is seen. Writes how that moves with the point into `follows` (2, 3),
    pixels per metre."""
    u, v, seen = project_point(camera, p[0], p[1], p[2])
    step_m = max(STEP * math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]), 1e-9)
    for axis in range(3):
        x_m = step_m if axis == 0 else 0.0
        y_m = step_m if axis == 1 else 0.0
        z_m = step_m if axis == 2 else 0.0
        right, below, seen_ahead = project_point(camera, p[0] + x_m, p[1] + y_m, p[2] + z_m)
        left, above, seen_behind = project_point(camera, p[0] - x_m, p[1] - y_m, p[2] - z_m)
        seen = seen and seen_ahead and seen_behind
        follows[0, axis], follows[1, axis] = (right - left) / (2.0 * step_m), (below - above) / (2.0 * step_m)
    return u, v, seen


@njit(cache=True, error_model="numpy")
def _is_near(camera: Camera, u: float, v: float) -> bool:
    wide, high = MARGIN * camera.width, MARGIN * camera.height
    return bool(-wide <= u <= camera.width + wide and -high <= v <= camera.height + high)


@njit(cache=True, error_model="numpy")
def _moved_by(
    place: int, turned_m: NDArray[np.float64], passing_m: NDArray[np.float64], share: NDArray[np.float32], i: int
) -> tuple[float, float, float]:
    """How a point moves with a place of the pose or the clocks, m per unit. `turned_m` (3,) is the point in the camera
    frame, turned and not yet shifted; `passing_m` (3,) m/s likewise."""
    x, y, z = turned_m[0], turned_m[1], turned_m[2]
    if place == 0:
        return 0.0, -z, y
    if place == 1:
        return z, 0.0, -x
    if place == 2:
        return -y, x, 0.0
    if place < 6:
        return 1.0 if place == 3 else 0.0, 1.0 if place == 4 else 0.0, 1.0 if place == 5 else 0.0
    s = share[place - 6, i]
    return s * passing_m[0], s * passing_m[1], s * passing_m[2]
