"""How significantly range edges fall on image edges at a pose: the second witness beside mutual information.

    z = Σ w·e / √Σ w²

over the range edges in view, with e the standardised edge strength at their pixel and w their weight. Were the edges
laid at random, z would have mean 0 and standard deviation about 1, however many are in view: looking away does not pay
(METHOD, section 3, "significance").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, project_point
from coec.geometry.compiler import njit, prange
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID
from coec.geometry.pixel_lookup import moved

BLOCK = 256
"""Points that are projected at a time: their pixels (4 kB) stay in the first-level cache until they are looked up."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFrames:
    """Range edges and edge maps of the frames of a window, at one level.

    Attributes:
        camera: intrinsics at the resolution of the maps.
        xyz_m: (3, E) float32 LiDAR frame, frames one after the other, motion-compensated.
        weight: (E,) float32.
        first_point: (F + 1,) int64.
        maps: (F, h, w) int8, as in `EdgePyramid`.
    """

    camera: Camera
    xyz_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    first_point: NDArray[np.int64]
    maps: NDArray[np.int8]

    def of_points(self, kept: NDArray[np.int64]) -> EdgeFrames:
        """Those with the given indices, ascending, on the same maps."""
        return replace(
            self,
            xyz_m=np.ascontiguousarray(self.xyz_m[:, kept]),
            weight=self.weight[kept],
            first_point=np.searchsorted(kept, self.first_point).astype(np.int64),
        )


LEAST_SQUARE = 1e-9
"""Least Σ w² that a significance divides by: where nothing is in view it is 0, and not 0 / 0. A single range edge has
more than 0.5."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Sums over the range edges in view at one pose, per frame: `strength` (F,) Σ w·e, `square` (F,) Σ w²."""

    strength: NDArray[np.float64]
    square: NDArray[np.float64]

    @property
    def significance(self) -> float:
        """z of all frames together; 0 where nothing is in view."""
        return float(self.strength.sum() / self._scale)

    @property
    def of_frames(self) -> NDArray[np.float64]:
        """(F,) what each frame adds to z, F times: their mean is `significance`."""
        return np.asarray(len(self.strength) * self.strength / self._scale)

    @property
    def _scale(self) -> float:
        return math.sqrt(max(float(self.square.sum()), LEAST_SQUARE))


def frame_alignment(frames: EdgeFrames, T_camera_lidar: NDArray[np.float64]) -> Alignment:
    """The alignment at one pose (4, 4), with e interpolated between pixels: smooth in the pose."""
    pose = np.ascontiguousarray(T_camera_lidar, np.float64)
    sums = _smooth_sums(frames.camera, pose, frames.xyz_m, frames.weight, frames.first_point, frames.maps)
    return Alignment(sums[:, 0], sums[:, 1])


def significances(frames: EdgeFrames, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """z at many poses (K, 4, 4), with e at the nearest pixel: (K,)."""
    return np.asarray(
        _nearest_pixel_z(frames.camera, poses, frames.xyz_m, frames.weight, frames.first_point, frames.maps)
    )


@njit(cache=True, parallel=True)
def _smooth_sums(
    camera: Camera,
    T: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
) -> NDArray[np.float64]:
    frames = first_point.shape[0] - 1
    sums = np.zeros((frames, 2))
    for f in prange(frames):
        strength, square = 0.0, 0.0
        u, v = np.empty(BLOCK), np.empty(BLOCK)
        for begin in range(first_point[f], first_point[f + 1], BLOCK):
            end = min(begin + BLOCK, first_point[f + 1])
            _pixels(camera, T, xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end], u, v)
            for i in range(end - begin):
                if not (u[i] >= 0.0 and v[i] >= 0.0 and u[i] < camera.width - 1.0 and v[i] < camera.height - 1.0):
                    continue
                column, row = int(u[i]), int(v[i])
                p, q = maps[f, row, column], maps[f, row, column + 1]
                r, s = maps[f, row + 1, column], maps[f, row + 1, column + 1]
                if p != VOID and q != VOID and r != VOID and s != VOID:
                    a, b = u[i] - column, v[i] - row
                    e = (1.0 - b) * ((1.0 - a) * p + a * q) + b * ((1.0 - a) * r + a * s)
                    w = float(weight[begin + i])
                    strength += w * e
                    square += w * w
        sums[f, 0], sums[f, 1] = strength / STRENGTH_STEPS, square
    return sums


@njit(cache=True, parallel=True)
def _nearest_pixel_z(
    camera: Camera,
    poses: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
) -> NDArray[np.float64]:
    z = np.empty(poses.shape[0])
    for k in prange(poses.shape[0]):
        z[k] = _nearest_pixel_z_at(camera, poses[k], xyz, weight, first_point, maps)
    return z


@njit(cache=True)
def _nearest_pixel_z_at(
    camera: Camera,
    T: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
) -> float:
    strength, square = 0.0, 0.0
    u, v = np.empty(BLOCK), np.empty(BLOCK)
    for f in range(first_point.shape[0] - 1):
        for begin in range(first_point[f], first_point[f + 1], BLOCK):
            end = min(begin + BLOCK, first_point[f + 1])
            _pixels(camera, T, xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end], u, v)
            for i in range(end - begin):
                if u[i] >= -0.5 and v[i] >= -0.5 and u[i] < camera.width - 0.5 and v[i] < camera.height - 0.5:
                    e = maps[f, int(v[i] + 0.5), int(u[i] + 0.5)]
                    if e != VOID:
                        w = float(weight[begin + i])
                        strength += w * e
                        square += w * w
    return strength / (STRENGTH_STEPS * math.sqrt(max(square, LEAST_SQUARE)))


@njit(cache=True, error_model="numpy")
def _pixels(
    camera: Camera,
    T: NDArray[np.float64],
    x_m: NDArray[np.float32],
    y_m: NDArray[np.float32],
    z_m: NDArray[np.float32],
    u: NDArray[np.float64],
    v: NDArray[np.float64],
) -> None:
    """Pixel coordinates of points (n,), LiDAR frame, into the first n of `u` and `v`; -1 where there is none. A loop of
    its own, without a branch: it runs in vector registers."""
    for i in range(x_m.shape[0]):
        x, y, z = moved(T, float(x_m[i]), float(y_m[i]), float(z_m[i]))
        across, down, valid = project_point(camera, x, y, z)
        u[i], v[i] = (across if valid else -1.0), (down if valid else -1.0)
