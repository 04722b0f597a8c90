"""How significantly range edges fall on image edges at a pose: the second witness beside mutual information.

    z = Σ w·e / √Σ w²

over the range edges in view, with e the standardised edge strength at their pixel and w their weight. Were the edges
laid at random, z would have mean 0 and standard deviation about 1, however many are in view: looking away does not pay
(METHOD, section 3, "significance").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, project_point


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFrames:
    """Range edges and edge maps of the frames of a window, at one level.

    Attributes:
        camera: intrinsics at the resolution of the maps.
        xyz_m: (3, E) float32 LiDAR frame, frames one after the other, motion-compensated.
        weight: (E,) float32.
        first_point: (F + 1,) int64.
        maps: (F, h, w) float32, standardised; NaN where masked.
    """

    camera: Camera
    xyz_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    first_point: NDArray[np.int64]
    maps: NDArray[np.float32]


def frame_alignment(
    frames: EdgeFrames, T_camera_lidar: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Per frame Σ w·e and Σ w² (F,) at one pose (4, 4), with e interpolated between pixels: smooth in the pose."""
    pose = np.ascontiguousarray(T_camera_lidar, np.float64)
    sums = _smooth_sums(frames.camera, pose, frames.xyz_m, frames.weight, frames.first_point, frames.maps)
    return sums[:, 0], sums[:, 1]


def significances(frames: EdgeFrames, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """z at many poses (K, 4, 4), with e at the nearest pixel: (K,)."""
    return np.asarray(
        _significances(frames.camera, poses, frames.xyz_m, frames.weight, frames.first_point, frames.maps)
    )


@njit(cache=True, parallel=True)
def _smooth_sums(
    camera: Camera,
    T: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.float32],
) -> NDArray[np.float64]:
    frames = first_point.shape[0] - 1
    sums = np.zeros((frames, 2))
    for f in prange(frames):
        strength, square = 0.0, 0.0
        for i in range(first_point[f], first_point[f + 1]):
            u, v, valid = _pixel(camera, T, xyz, i)
            if valid and u >= 0.0 and v >= 0.0 and u < camera.width - 1.0 and v < camera.height - 1.0:
                column, row = int(u), int(v)
                a, b = u - column, v - row
                e = (1.0 - b) * ((1.0 - a) * maps[f, row, column] + a * maps[f, row, column + 1]) + b * (
                    (1.0 - a) * maps[f, row + 1, column] + a * maps[f, row + 1, column + 1]
                )
                if e == e:  # not masked
                    w = float(weight[i])
                    strength += w * e
                    square += w * w
        sums[f, 0], sums[f, 1] = strength, square
    return sums


@njit(cache=True, parallel=True)
def _significances(
    camera: Camera,
    poses: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.float32],
) -> NDArray[np.float64]:
    z = np.empty(poses.shape[0])
    for k in prange(poses.shape[0]):
        z[k] = _significance(camera, poses[k], xyz, weight, first_point, maps)
    return z


@njit(cache=True)
def _significance(
    camera: Camera,
    T: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.float32],
) -> float:
    strength, square = 0.0, 0.0
    for f in range(first_point.shape[0] - 1):
        for i in range(first_point[f], first_point[f + 1]):
            u, v, valid = _pixel(camera, T, xyz, i)
            if valid and u >= -0.5 and v >= -0.5 and u < camera.width - 0.5 and v < camera.height - 0.5:
                e = maps[f, int(v + 0.5), int(u + 0.5)]
                if e == e:
                    w = float(weight[i])
                    strength += w * e
                    square += w * w
    return strength / math.sqrt(max(square, 1e-9))


@njit(cache=True, inline="always")
def _pixel(camera: Camera, T: NDArray[np.float64], xyz: NDArray[np.float32], i: int) -> tuple[float, float, bool]:
    x, y, z = float(xyz[0, i]), float(xyz[1, i]), float(xyz[2, i])
    return project_point(
        camera,
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )
