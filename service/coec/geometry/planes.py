"""Planes fitted to points and their neighbours: the local surface, and how certain its tilt is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import njit

SWEEPS = 8
"""Sweeps of Jacobi's rotations over a 3×3 matrix; it is diagonal to the last bit after four or five."""


class Planes(NamedTuple):
    """One plane for each of N queries.

    Attributes:
        centre: (N, 3) mean of the neighbours.
        normal: (N, 3) unit; its sign is arbitrary.
        spread: (N, 3) standard deviations of the neighbours along the normal and along the two axes in the plane,
            ascending, metres; NaN with fewer than three neighbours.
        axes: (N, 2, 3) the two unit axes in the plane.
        used: (N,) number of neighbours used.
    """

    centre: NDArray[np.float64]
    normal: NDArray[np.float64]
    spread: NDArray[np.float64]
    axes: NDArray[np.float64]
    used: NDArray[np.int64]


def planes_through(
    points: NDArray[np.float64], neighbours: NDArray[np.int64], squared_m2: NDArray[np.float64], reach_m: float
) -> Planes:
    """The least-squares plane through the neighbours of each query.

    Args:
        points: (M, 3).
        neighbours: (N, k) indices of points.
        squared_m2: (N, k) squared distances from the query.
        reach_m: neighbours farther from the query than this are left out.
    """
    return Planes(*_planes(points, neighbours, squared_m2, reach_m * reach_m))


@njit(cache=True)
def _planes(
    points: NDArray[np.float64], neighbours: NDArray[np.int64], squared: NDArray[np.float64], within: float
) -> tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]
]:  # fmt: skip
    n, k = neighbours.shape
    centre, normal = np.zeros((n, 3)), np.zeros((n, 3))
    spread, axes = np.full((n, 3), np.nan), np.zeros((n, 2, 3))
    count = np.zeros(n, np.int64)
    for i in range(n):
        used = 0
        for j in range(k):
            if squared[i, j] <= within:
                used += 1
                for c in range(3):
                    centre[i, c] += points[neighbours[i, j], c]
        count[i] = used
        if used < 3:
            continue
        for c in range(3):
            centre[i, c] /= used
        a = np.zeros((3, 3))
        for j in range(k):
            if squared[i, j] <= within:
                for r in range(3):
                    for c in range(3):
                        a[r, c] += (points[neighbours[i, j], r] - centre[i, r]) * (
                            points[neighbours[i, j], c] - centre[i, c]
                        )
        v = _turned_to_axes(a)
        order = np.argsort(np.array([a[0, 0], a[1, 1], a[2, 2]]))
        for c in range(3):
            spread[i, c] = np.sqrt(max(a[order[c], order[c]], 0.0) / used)
            normal[i, c] = v[c, order[0]]
            axes[i, 0, c] = v[c, order[1]]
            axes[i, 1, c] = v[c, order[2]]
    return centre, normal, spread, axes, count


@njit(cache=True)
def _turned_to_axes(a: NDArray[np.float64]) -> NDArray[np.float64]:
    """Makes a symmetric (3, 3) matrix diagonal, in place, by Jacobi's rotations (Golub, Van Loan 2013, section 8.5).
    Returns a (3, 3) whose columns are its axes."""
    v = np.eye(3)
    for _ in range(SWEEPS):
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                tau = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = np.copysign(1.0, tau) / (abs(tau) + np.sqrt(1.0 + tau * tau))
                cosine = 1.0 / np.sqrt(1.0 + t * t)
                sine = t * cosine
                for r in range(3):
                    x, y = a[r, p], a[r, q]
                    a[r, p], a[r, q] = cosine * x - sine * y, sine * x + cosine * y
                for r in range(3):
                    x, y = a[p, r], a[q, r]
                    a[p, r], a[q, r] = cosine * x - sine * y, sine * x + cosine * y
                for r in range(3):
                    x, y = v[r, p], v[r, q]
                    v[r, p], v[r, q] = cosine * x - sine * y, sine * x + cosine * y
    return v
