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


@dataclass(frozen=True, slots=True, eq=False)
class PartedAlignment:
    """As `Alignment`, per frame and part: `strength` (F, P) Σ w·e, `square` (F, P) Σ w²."""

    strength: NDArray[np.float64]
    square: NDArray[np.float64]


def frame_alignment(frames: EdgeFrames, T_camera_lidar: NDArray[np.float64]) -> Alignment:
    """The alignment at one pose (4, 4), with e interpolated between pixels: smooth in the pose."""
    pose = np.ascontiguousarray(T_camera_lidar, np.float64)
    sums = _smooth_sums(frames.camera, pose, frames.xyz_m, frames.weight, frames.first_point, frames.maps)
    return Alignment(sums[:, 0], sums[:, 1])


def alignment_of_parts(
    frames: EdgeFrames, part: NDArray[np.uint8], parts: int, T_camera_lidar: NDArray[np.float64]
) -> PartedAlignment:
    """The same at one pose (4, 4), of each of so many `parts` of the range edges by itself; `part` (E,) is where each
    belongs."""
    pose = np.ascontiguousarray(T_camera_lidar, np.float64)
    sums = _smooth_sums_of_parts(
        frames.camera, pose, frames.xyz_m, frames.weight, part, frames.first_point, frames.maps, parts
    )
    return PartedAlignment(sums[:, :, 0], sums[:, :, 1])


def significances(frames: EdgeFrames, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """z at many poses (K, 4, 4), with e at the nearest pixel: (K,)."""
    return np.asarray(
        _nearest_pixel_z(frames.camera, poses, frames.xyz_m, frames.weight, frames.first_point, frames.maps)
    )


def smooth_significances(frames: EdgeFrames, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """z at many poses (K, 4, 4), with e interpolated between pixels: (K,). To the last bits that of
    `frame_alignment`."""
    return np.asarray(_smooth_z(frames.camera, poses, frames.xyz_m, frames.weight, frames.first_point, frames.maps))


@njit(cache=True, parallel=True, error_model="numpy")
def _smooth_z(
    camera: Camera,
    poses: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
) -> NDArray[np.float64]:
    frames = first_point.shape[0] - 1
    sums = np.empty((poses.shape[0], frames, 2))
    for task in prange(poses.shape[0] * frames):
        k, f = task // frames, task % frames
        sums[k, f] = _smooth_sums_of_frame(camera, poses[k], xyz, weight, first_point[f], first_point[f + 1], maps[f])
    z = np.empty(poses.shape[0])
    for k in range(poses.shape[0]):
        strength, square = 0.0, 0.0
        for f in range(frames):
            strength += sums[k, f, 0]
            square += sums[k, f, 1]
        z[k] = strength / math.sqrt(max(square, LEAST_SQUARE))
    return z


@njit(cache=True, parallel=True, error_model="numpy")
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
        sums[f] = _smooth_sums_of_frame(camera, T, xyz, weight, first_point[f], first_point[f + 1], maps[f])
    return sums


@njit(cache=True, error_model="numpy")
def _smooth_sums_of_frame(
    camera: Camera,
    T: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    first: int,
    last: int,
    edge_map: NDArray[np.int8],
) -> tuple[float, float]:
    """Σ w·e and Σ w² over the range edges of one frame, those from `first` to before `last`."""
    strength, square = 0.0, 0.0
    u, v, place = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK, np.int32)
    edges = edge_map.ravel()
    for begin in range(first, last, BLOCK):
        end = min(begin + BLOCK, last)
        _pixels(camera, T, xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end], u, v)
        _split(camera, u[: end - begin], v[: end - begin], place)
        for i in range(end - begin):
            if place[i] >= 0:
                e, seen = _between(edges, camera.width, place[i], u[i], v[i])
                if seen:
                    w = float(weight[begin + i])
                    strength += w * e
                    square += w * w
    return strength / STRENGTH_STEPS, square


@njit(cache=True, parallel=True, error_model="numpy")
def _smooth_sums_of_parts(
    camera: Camera,
    T: NDArray[np.float64],
    xyz: NDArray[np.float32],
    weight: NDArray[np.float32],
    part: NDArray[np.uint8],
    first_point: NDArray[np.int64],
    maps: NDArray[np.int8],
    parts: int,
) -> NDArray[np.float64]:
    frames = first_point.shape[0] - 1
    sums = np.zeros((frames, parts, 2))
    for f in prange(frames):
        u, v, place = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK, np.int32)
        edges, of_frame = maps[f].ravel(), sums[f]
        for begin in range(first_point[f], first_point[f + 1], BLOCK):
            end = min(begin + BLOCK, first_point[f + 1])
            _pixels(camera, T, xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end], u, v)
            _split(camera, u[: end - begin], v[: end - begin], place)
            for i in range(end - begin):
                if place[i] >= 0:
                    e, seen = _between(edges, camera.width, place[i], u[i], v[i])
                    if seen:
                        w, k = float(weight[begin + i]), part[begin + i]
                        of_frame[k, 0] += w * e
                        of_frame[k, 1] += w * w
        of_frame[:, 0] /= STRENGTH_STEPS
    return sums


@njit(cache=True, error_model="numpy")
def _split(camera: Camera, u: NDArray[np.float64], v: NDArray[np.float64], place: NDArray[np.int32]) -> None:
    """Pixel coordinates (n,) as the pixel above and to the left (row · width + column) into `place`, -1 where there is
    none, and what is left of them, in place. Without a branch, as `_pixels`."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    for i in range(u.shape[0]):
        inside = (u[i] >= 0.0) & (v[i] >= 0.0) & (u[i] < right) & (v[i] < bottom)
        across, down = (u[i] if inside else 0.0), (v[i] if inside else 0.0)
        column, row = np.floor(across), np.floor(down)
        u[i], v[i] = across - column, down - row
        place[i] = np.int32(row * camera.width + column) if inside else np.int32(-1)


@njit(cache=True, inline="always")
def _between(edges: NDArray[np.int8], width: int, place: np.int32, right: float, down: float) -> tuple[float, bool]:
    """The strength, in steps, between a pixel of a map (h·w,), its neighbours to the right and below and the one
    between those, so much aside; and whether all four have one."""
    here = np.uint64(place)
    below = here + np.uint64(width)
    p, q, r, s = edges[here], edges[here + np.uint64(1)], edges[below], edges[below + np.uint64(1)]
    upper, lower = (1.0 - right) * p + right * q, (1.0 - right) * r + right * s
    return (1.0 - down) * upper + down * lower, (p != VOID) & (q != VOID) & (r != VOID) & (s != VOID)


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
