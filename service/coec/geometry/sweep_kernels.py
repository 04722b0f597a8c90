"""Compiled kernels over the points of a sweep: azimuth, elevation and range; planes fitted to points and their
neighbours; motion compensation (deskew) by a constant twist.

Let p be a point measured dt after the reference instant, in the sensor frame at that time. In the sensor frame of the
reference instant it has the coordinates exp(ξ·dt)·p, with ξ = (ω, v) the twist of the sensor in its own frame (METHOD,
section 3, "Motion compensation is visible").
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange

_STEEP = np.float32(math.tan(math.pi / 8.0))
_EIGHTH, _QUARTER, _HALF = np.float32(math.pi / 4.0), np.float32(math.pi / 2.0), np.float32(math.pi)
_A, _B, _C, _D = (
    np.float32(8.05374449538e-2), np.float32(-1.38776856032e-1), np.float32(1.99777106478e-1),
    np.float32(-3.33329491539e-1),
)  # fmt: skip
"""Coefficients of the arctangent up to an eighth of a turn (S. L. Moshier, Cephes, `atanf`: to 2e-7 rad)."""

_BLOCK = 4096
"""Points that a thread takes at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """Bearings of N points, each (N,) float32: `azimuth` (-π to π, from x to y) and `elevation` (from the xy plane),
    radians, and `range_m`."""

    azimuth: NDArray[np.float32]
    elevation: NDArray[np.float32]
    range_m: NDArray[np.float32]


def bearings(xyz_m: NDArray[np.float32]) -> Bearings:
    """Bearings of points (N, 3). Angles are right to 5e-7 rad; those of the origin are zero."""
    points_m = np.ascontiguousarray(xyz_m, np.float32).view()
    # Always read-only, so that the kernel is compiled for one type of array only.
    points_m.setflags(write=False)
    return Bearings(*_bearings(points_m))


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _bearings(
    xyz: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    count = xyz.shape[0]
    azimuth, elevation = np.empty(count, np.float32), np.empty(count, np.float32)
    range_m = np.empty(count, np.float32)
    for block in prange(-(-count // _BLOCK)):
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            flat = x * x + y * y
            azimuth[i] = _angle(y, x)
            elevation[i] = _angle(z, np.sqrt(flat))
            range_m[i] = np.sqrt(flat + z * z)
    return azimuth, elevation, range_m


@njit(cache=True, inline="always", error_model="numpy")
def _angle(y: np.float32, x: np.float32) -> np.float32:
    """The angle of (x, y). It uses selections instead of branches, so that the loop runs in vector registers, in a
    tenth of the time of the library's function."""
    across, along = abs(y), abs(x)
    less, more = (across if across < along else along), (along if across < along else across)
    t = less / (more if more > np.float32(0.0) else np.float32(1.0))
    beyond = t > _STEEP
    one = np.float32(1.0)
    t = (t - one) / (t + one) if beyond else t
    square = t * t
    angle = (((_A * square + _B) * square + _C) * square + _D) * square * t + t
    angle = angle + _EIGHTH if beyond else angle
    angle = _QUARTER - angle if across > along else angle
    angle = _HALF - angle if x < np.float32(0.0) else angle
    return -angle if y < np.float32(0.0) else angle


@njit(cache=True)
def grid_counts(
    elevation: NDArray[np.float32], azimuth: NDArray[np.float32], low: float, high: float, bands: int, sectors: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Counts of the points (N,) between two elevations: by band of elevation (bands,) and by sector of azimuth
    (sectors,)."""
    of_bands, of_sectors = np.zeros(bands, np.int64), np.zeros(sectors, np.int64)
    per_band, per_sector = bands / (high - low), sectors / (2.0 * math.pi)
    for i in range(elevation.shape[0]):
        if low <= elevation[i] <= high:
            of_bands[min(int((elevation[i] - low) * per_band), bands - 1)] += 1
            of_sectors[min(int((azimuth[i] + math.pi) * per_sector), sectors - 1)] += 1
    return of_bands, of_sectors


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


SMALL_RAD = 0.01
"""Below this turn two terms of a series replace the sines: the third is a ten-thousandth of a millionth of the first. A
sweep turns by less except in sharp bends, and a sine takes as long as all the rest."""


def deskew(
    xyz_m: NDArray[np.float32],
    dt_s: NDArray[np.float64],
    angular_radps: NDArray[np.float64],
    linear_mps: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Points at the reference instant.

    Args:
        xyz_m: (N, 3) float32, sensor frame at each point's own instant.
        dt_s: (N,) time of each point after the reference instant, seconds.
        angular_radps: (3,) angular velocity of the sensor in the sensor frame, rad/s.
        linear_mps: (3,) linear velocity of the sensor origin in the sensor frame, m/s.

    Returns:
        (N, 3) float32: exp(ξ·dt)·p, the closed form of SE(3)'s exponential (Rodrigues).
    """
    points_m = np.ascontiguousarray(xyz_m, np.float32).view()
    # Always read-only, so that the kernel is compiled for one type of array only.
    points_m.setflags(write=False)
    moved_m: NDArray[np.float32] = _deskew(points_m, dt_s, angular_radps, linear_mps)
    return moved_m


@njit(cache=True)
def _deskew(
    xyz_m: NDArray[np.float32],
    dt_s: NDArray[np.float64],
    angular_radps: NDArray[np.float64],
    linear_mps: NDArray[np.float64],
) -> NDArray[np.float32]:
    out = np.empty(xyz_m.shape, np.float32)
    wx, wy, wz = angular_radps[0], angular_radps[1], angular_radps[2]
    vx, vy, vz = linear_mps[0], linear_mps[1], linear_mps[2]
    rate = math.sqrt(wx * wx + wy * wy + wz * wz)
    for i in range(xyz_m.shape[0]):
        t = dt_s[i]
        angle = rate * t
        if abs(angle) < SMALL_RAD:
            square = angle * angle
            a = t * (1.0 - square / 6.0)
            b = 0.5 * t * t * (1.0 - square / 12.0)
            c = t * t * t / 6.0 * (1.0 - square / 20.0)
        else:
            a = math.sin(angle) / rate
            b = (1.0 - math.cos(angle)) / (rate * rate)
            c = (t - a) / (rate * rate)
        x, y, z = float(xyz_m[i, 0]), float(xyz_m[i, 1]), float(xyz_m[i, 2])
        # exp(ξt)p = p + a (ω×p) + b ω×(ω×p) + t v + b (ω×v) + c ω×(ω×v)
        cx, cy, cz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        dx, dy, dz = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
        ex, ey, ez = b * cx + c * dx, b * cy + c * dy, b * cz + c * dz
        out[i, 0] = x + a * cx + t * vx + b * dx + (wy * ez - wz * ey)
        out[i, 1] = y + a * cy + t * vy + b * dy + (wz * ex - wx * ez)
        out[i, 2] = z + a * cz + t * vz + b * dz + (wx * ey - wy * ex)
    return out
