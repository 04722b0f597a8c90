"""The alignment of range edges with image edges while many parameters displace them: pose, clocks, lens.

The pixel of a range edge is linear in the parameters, u(x) = u₀ + J·x, so that the kernels need no camera model once
they have J, cost about as much for any number of parameters, and give the gradient with the value. Who calls them
linearises again where it ends.

Arrays have the edges last: blocks of `BLOCK` edges go through each step together, sixteen numbers to an instruction.
Sums are taken in an order that does not depend on the processor.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, project_point
from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.edges.alignment import LEAST_SQUARE
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID

BLOCK = 64

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
        first_point: (F + 1,) int64, frames one after the other.
        maps: (F, h, w) int8, as in `EdgePyramid`.
    """

    uv_px: NDArray[np.float32]
    jacobian: NDArray[np.float32]
    weight: NDArray[np.float32]
    first_point: NDArray[np.int64]
    maps: NDArray[np.int8]

    def along(self, axes: NDArray[np.float64]) -> "DisplacedEdges":
        """The same edges as a function of coordinates along `axes` (n, m), columns in the space of the parameters."""
        jacobian = np.einsum("kie,kn->nie", self.jacobian, axes.astype(np.float32))
        return replace(self, jacobian=np.ascontiguousarray(jacobian))

    def significance(self, x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """z at the parameters x (n,), and its gradient (n,). What leaves the view does not count in the gradient."""
        z, gradients = self.gradients_at(x[None])
        return float(z[0]), gradients[0]

    def significances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K,) z at K points (K, n), without gradients."""
        sums = np.cumsum(_sums_at(*self._arguments, points.astype(np.float32), False), axis=1)[:, -1]
        return np.asarray(sums[:, 0] / np.sqrt(np.maximum(sums[:, 1], LEAST_SQUARE)))

    def gradients_at(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(K,) z at K points (K, n), and (K, n) its gradients."""
        sums = np.cumsum(_sums_at(*self._arguments, points.astype(np.float32), True), axis=1)[:, -1]
        root = np.sqrt(np.maximum(sums[:, 1], LEAST_SQUARE))
        return sums[:, 0] / root, sums[:, 2:] / root[:, None]

    def gradients_of_cells(
        self, cell: NDArray[np.uint8], cells: int, x: NDArray[np.float64], along: int
    ) -> NDArray[np.float64]:
        """(m, F, cells) what the range edges of each frame and cell add to the gradient of z at x (n,), along the first
        m parameters (`along`); `cell` (E,) is the cell of each."""
        sums = _sums_of_cells(*self._arguments, cell, cells, x.astype(np.float32), along)
        root = math.sqrt(max(float(np.cumsum(sums[:, :, 0].ravel())[-1]), LEAST_SQUARE))
        return np.moveaxis(sums[:, :, 1:], 2, 0) / root

    @property
    def _arguments(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], NDArray[np.int8]]:
        return self.uv_px, self.jacobian, self.weight, self.first_point, self.maps


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _sums_at(
    uv: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    points: NDArray[np.float32],
    with_gradient: bool,
) -> NDArray[np.float64]:
    """(K, F, 2 + n): Σ w·e, Σ w² and the gradient of the first (0 without), of each frame at points (K, n)."""
    frames, n = first_point.shape[0] - 1, points.shape[1]
    sums = np.zeros((points.shape[0], frames, 2 + n))
    for task in prange(points.shape[0] * frames):
        # Frame by frame, so that its map stays in the cache.
        f, k = task // points.shape[0], task % points.shape[0]
        u, v = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        lanes = np.zeros((n, BLOCK), np.float32)
        strength, square = 0.0, 0.0
        for first in range(first_point[f], first_point[f + 1], BLOCK):
            count = min(BLOCK, first_point[f + 1] - first)
            _displace(uv, jacobian, points[k], first, count, u, v)
            for i in range(count):
                w = weight[first + i]
                seen, value, across, down = _interpolated(maps[f], u[i], v[i])
                if seen:
                    strength += w * value
                    square += w * w
                u[i], v[i] = w * across, w * down
            if with_gradient:
                for j in range(n):
                    _add_slopes(jacobian, j, first, count, u, v, lanes[j])
        sums[k, f, 0], sums[k, f, 1] = strength / STRENGTH_STEPS, square
        for j in range(n):
            total = 0.0
            for i in range(BLOCK):
                total += lanes[j, i]
            sums[k, f, 2 + j] = total / STRENGTH_STEPS
    return sums


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _sums_of_cells(
    uv: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    cell: NDArray[np.uint8],
    cells: int,
    x: NDArray[np.float32],
    along: int,
) -> NDArray[np.float64]:
    """(F, cells, 1 + m): Σ w² and the gradient of Σ w·e along the first m parameters, of each frame and cell at x."""
    frames = first_point.shape[0] - 1
    sums = np.zeros((frames, cells, 1 + along))
    for f in prange(frames):
        u, v = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        for first in range(first_point[f], first_point[f + 1], BLOCK):
            count = min(BLOCK, first_point[f + 1] - first)
            _displace(uv, jacobian, x, first, count, u, v)
            for i in range(count):
                w, of_cell = weight[first + i], sums[f, cell[first + i]]
                seen, _, across, down = _interpolated(maps[f], u[i], v[i])
                if not seen:
                    continue
                of_cell[0] += w * w
                across, down = w * across / np.float32(STRENGTH_STEPS), w * down / np.float32(STRENGTH_STEPS)
                for j in range(along):
                    of_cell[1 + j] += across * jacobian[j, 0, first + i] + down * jacobian[j, 1, first + i]
    return sums


@njit(cache=True, error_model="numpy")
def _displace(
    uv: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    x: NDArray[np.float32],
    first: int,
    count: int,
    u: NDArray[np.float32],
    v: NDArray[np.float32],
) -> None:
    """Writes the pixels of a block of edges at x (n,) into u and v."""
    for i in range(count):
        u[i], v[i] = uv[0, first + i], uv[1, first + i]
    for j in range(x.shape[0]):
        across, down, xj = jacobian[j, 0, first : first + count], jacobian[j, 1, first : first + count], x[j]
        for i in range(count):
            u[i] += across[i] * xj
        for i in range(count):
            v[i] += down[i] * xj


@njit(cache=True, error_model="numpy")
def _add_slopes(
    jacobian: NDArray[np.float32],
    j: int,
    first: int,
    count: int,
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    lanes: NDArray[np.float32],
) -> None:
    """Adds what a block of edges contributes to the gradient along parameter j, one lane for each place in a block."""
    of_u, of_v = jacobian[j, 0, first : first + count], jacobian[j, 1, first : first + count]
    for i in range(count):
        lanes[i] += across[i] * of_u[i] + down[i] * of_v[i]


@njit(cache=True, error_model="numpy")
def _interpolated(
    edges: NDArray[np.int8], u: np.float32, v: np.float32
) -> tuple[bool, np.float32, np.float32, np.float32]:
    """Whether the four pixels around a place count, the strength there in steps, and its slopes across and down."""
    none = np.float32(0.0)
    if not (u >= 0.0 and v >= 0.0 and u < edges.shape[1] - 1 and v < edges.shape[0] - 1):
        return False, none, none, none
    column, row = int(u), int(v)
    p, q = edges[row, column], edges[row, column + 1]
    r, s = edges[row + 1, column], edges[row + 1, column + 1]
    if p == VOID or q == VOID or r == VOID or s == VOID:
        return False, none, none, none
    right, below = u - np.float32(column), v - np.float32(row)
    over, under = np.float32(q) - np.float32(p), np.float32(s) - np.float32(r)
    upper, lower = np.float32(p) + right * over, np.float32(r) + right * under
    return True, upper + below * (lower - upper), over + below * (under - over), lower - upper


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
            u, v, seen = project_point(camera, p[0], p[1], p[2])
            step_m = max(STEP * math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]), 1e-9)
            for axis in range(3):
                right, below, seen_ahead = project_point(
                    camera,
                    p[0] + (step_m if axis == 0 else 0.0),
                    p[1] + (step_m if axis == 1 else 0.0),
                    p[2] + (step_m if axis == 2 else 0.0),
                )
                left, above, seen_behind = project_point(
                    camera,
                    p[0] - (step_m if axis == 0 else 0.0),
                    p[1] - (step_m if axis == 1 else 0.0),
                    p[2] - (step_m if axis == 2 else 0.0),
                )
                seen = seen and seen_ahead and seen_behind
                follows[0, axis], follows[1, axis] = (right - left) / (2.0 * step_m), (below - above) / (2.0 * step_m)
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
