"""Motion compensation (deskew) of a sweep: a constant twist carries every point to one reference instant.

Let p be a point measured dt after the reference instant, in the sensor frame at that time. In the sensor frame of the
reference instant it has the coordinates exp(ξ·dt)·p, with ξ = (ω, v) the twist of the sensor in its own frame (METHOD,
section 3, "Motion compensation is visible").
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import njit

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
