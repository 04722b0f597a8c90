"""Very many poses, spread evenly over a ball of rotations and a ball of translations."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange

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
