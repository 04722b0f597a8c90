"""The alignment of range edges with image edges while many parameters displace them: pose, lens, clocks.

The pixel of a range edge is linear in the parameters, u(x) = u₀ + J·x, so that the kernel needs no camera model, costs
as much for any number of parameters, and gives the gradient with the value. Who calls it linearises again where it
ends.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.edges.alignment import LEAST_SQUARE
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID


@dataclass(frozen=True, slots=True, eq=False)
class DisplacedEdges:
    """Range edges on edge maps, as a linear function of n parameters.

    Attributes:
        uv_px: (E, 2) float32 pixels at the point of linearisation.
        jacobian: (E, 2, n) float32 pixels per unit of each parameter.
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
        jacobian = np.einsum("eik,kn->ein", self.jacobian, axes.astype(np.float32))
        return replace(self, jacobian=jacobian)

    def significance(self, x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """z at the parameters x (n,), and its gradient (n,). What leaves the view does not count in the gradient."""
        sums = _sums_of_cells(*self._arguments, np.zeros(len(self.weight), np.uint8), 1, x.astype(np.float32))[:, 0]
        whole = np.cumsum(sums, axis=0)[-1]  # one frame after the other
        root = math.sqrt(max(float(whole[1]), LEAST_SQUARE))
        return float(whole[0]) / root, whole[2:] / root

    def significances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K,) z at K points (K, n), without gradients."""
        sums = np.cumsum(_sums_at(*self._arguments, points.astype(np.float32)), axis=1)[:, -1]
        return np.asarray(sums[:, 0] / np.sqrt(np.maximum(sums[:, 1], LEAST_SQUARE)))

    def gradients(self, cell: NDArray[np.uint8], cells: int) -> NDArray[np.float64]:
        """(n, F, cells) what the range edges of each frame and cell add to the gradient of z; `cell` (E,) is the cell
        of each."""
        n = self.jacobian.shape[2]
        sums = _sums_of_cells(*self._arguments, cell, cells, np.zeros(n, np.float32))
        root = math.sqrt(max(float(np.cumsum(sums[:, :, 1].ravel())[-1]), LEAST_SQUARE))
        return np.moveaxis(sums[:, :, 2:], 2, 0) / root

    @property
    def _arguments(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], NDArray[np.int8]]:
        return self.uv_px, self.jacobian, self.weight, self.first_point, self.maps


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
) -> NDArray[np.float64]:
    """(F, cells, 2 + n): Σ w·e, Σ w² and the gradient of the first, of each frame and cell at x (n,)."""
    frames, n = first_point.shape[0] - 1, x.shape[0]
    sums = np.zeros((frames, cells, 2 + n))
    for f in prange(frames):
        edges, of_frame = maps[f], sums[f]
        for i in range(first_point[f], first_point[f + 1]):
            u, v = _displaced(uv[i], jacobian[i], x)
            seen, strength, across, down = _interpolated(edges, u, v)
            if not seen:
                continue
            w = weight[i] / np.float32(STRENGTH_STEPS)
            of_cell = of_frame[cell[i]]
            of_cell[0] += w * strength
            of_cell[1] += weight[i] * weight[i]
            for k in range(n):
                of_cell[2 + k] += w * (across * jacobian[i, 0, k] + down * jacobian[i, 1, k])
    return sums


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _sums_at(
    uv: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    points: NDArray[np.float32],
) -> NDArray[np.float64]:
    """(K, F, 2): Σ w·e and Σ w² of each frame at points (K, n)."""
    frames = first_point.shape[0] - 1
    sums = np.zeros((points.shape[0], frames, 2))
    for task in prange(points.shape[0] * frames):
        k, f = task // frames, task % frames
        edges = maps[f]
        strength, square = 0.0, 0.0
        for i in range(first_point[f], first_point[f + 1]):
            u, v = _displaced(uv[i], jacobian[i], points[k])
            seen, value, _, _ = _interpolated(edges, u, v)
            if seen:
                strength += weight[i] * value
                square += weight[i] * weight[i]
        sums[k, f, 0], sums[k, f, 1] = strength / STRENGTH_STEPS, square
    return sums


@njit(cache=True, error_model="numpy")
def _displaced(
    uv: NDArray[np.float32], jacobian: NDArray[np.float32], x: NDArray[np.float32]
) -> tuple[np.float32, np.float32]:
    u, v = uv[0], uv[1]
    for k in range(x.shape[0]):
        u += jacobian[0, k] * x[k]
        v += jacobian[1, k] * x[k]
    return u, v


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
