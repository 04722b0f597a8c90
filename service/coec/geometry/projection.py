"""Projection of arrays with any camera model, by the formulas of `coec.geometry.cameras` compiled into a loop; the
nearest pixel of many points at one pose, in single precision, sixteen points to an instruction, and in double
precision where single precision cannot decide; which points of a sweep a camera sees; and culling of points that
cannot be in view: once for a whole search, or in bundles of neighbours at each pose.

A pixel is a rounded coordinate. All but about one point in a thousand lie so far from the border of their pixel that
the error of single precision does not matter. The loop marks the others, and for those the caller calls `exact_pixel`.
This is the floating-point filter of exact geometric predicates (J. R. Shewchuk, "Adaptive Precision Floating-Point
Arithmetic and Fast Robust Geometric Predicates", 1997), but its error bound is measured, not derived: `filter_of`
projects a sample of the field of view in both precisions and takes `SAFETY` times the largest difference.

A bundle is a run of `BUNDLE` points of one frame. Seen from the LiDAR, its points lie in a cone: within some angle of
the bundle's axis. Seen from the camera, the cone is wider by their parallax. If the cone misses the field of view, none
of the points is in the image, and they are neither read nor projected.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import (
    Camera,
    domain_angle_rad,
    image_point,
    in_image,
    in_single_precision,
    project_point,
    unproject_point,
)
from coec.geometry.compiler import njit
from coec.geometry.points import lengths, rows_of


@njit(cache=True, error_model="numpy")
def _project(camera: Camera, p_camera: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    count = p_camera.shape[0]
    uv_px = np.empty((count, 2))
    valid = np.empty(count, np.bool_)
    for i in range(count):
        uv_px[i, 0], uv_px[i, 1], valid[i] = project_point(camera, p_camera[i, 0], p_camera[i, 1], p_camera[i, 2])
    return uv_px, valid


@njit(cache=True, error_model="numpy")
def _unproject(camera: Camera, uv_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    count = uv_px.shape[0]
    rays = np.empty((count, 3))
    valid = np.empty(count, np.bool_)
    for i in range(count):
        rays[i, 0], rays[i, 1], rays[i, 2], valid[i] = unproject_point(camera, uv_px[i, 0], uv_px[i, 1])
    return rays, valid


def project(camera: Camera, p_camera: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pixels of points.

    p_camera: (N, 3), metres, camera frame. Returns uv_px (N, 2) and valid (N,); uv_px is finite throughout. A valid
    point need not lie in the image: see `in_image`. Raises ValueError for any other shape.
    """
    uv_px, valid = _project(camera, rows_of("p_camera", p_camera, 3))
    return uv_px, valid


def share_in_image(camera: Camera, T_camera_lidar: NDArray[np.float64], xyz_m: NDArray[np.floating]) -> float:
    """Share of the points (N, 3) that lie in the image at a pose (4, 4)."""
    p_camera: NDArray[np.float64] = xyz_m.astype(np.float64) @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
    uv_px, valid = project(camera, p_camera)
    inside = valid & in_image(camera, uv_px)
    return float(inside.mean()) if len(inside) else 0.0


def unproject(camera: Camera, uv_px: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Rays of pixels.

    uv_px: (N, 2). Returns unit vectors (N, 3) in the camera frame and valid (N,). Raises ValueError for any other
    shape.
    """
    rays, valid = _unproject(camera, rows_of("uv_px", uv_px, 2))
    return rays, valid


NOT_IN_IMAGE, UNSURE = -2, -1
"""Codes in place of a pixel: there is none, or single precision cannot decide. UNSURE is the larger, so that the
largest entry of a block tells whether there is anything to do for the block."""

SAFETY = 4.0
"""The error bound, in units of the largest error of the sample. Rounding errors are sums of some twenty independent
ones, so that the largest of a billion points is expected to be 1.4 times the largest of `SAMPLES`."""

SAMPLES = 65_536
"""Points over which the error is measured: half a hundred per degree of a 180° lens."""

EDGE_BAND = 1e-5
"""Points whose z/d is this near to the end of the model's domain are left to double precision. Single precision has z/d
to some 3e-7."""

FAR_M = 1e6
"""Points farther away than this are left to double precision, which also recognises those that are not numbers."""

NEAR_M = 1e-3
"""Points nearer than this are left to double precision, too."""

# The largest whole number up to which a float32 counts by ones: pixels are numbered in it.
_MAX_PIXELS = 2**24

# Only here may the compiler fuse, re-associate and estimate reciprocals. The results differ from one compilation to the
# next, but by less than the bound. NaN and infinity keep their meaning.
_LOOSE = {"contract", "reassoc", "nsz", "arcp", "afn"}

_HALF = np.float32(0.5)


class Certainty(NamedTuple):
    """Limits within which single precision can decide.

    Attributes:
        reach_px: a coordinate this far from the centre of its pixel, or farther, may belong to the next pixel; at most
            0.5.
        edge_cosine: z/d (of a point at distance d) at which the model's domain ends.
        near_m: points nearer to the camera than this are left to double precision. It is at least `NEAR_M` and at least
            the length of the pose's translation, because the shift can cancel most of the coordinates of nearer points.
    """

    reach_px: np.float32
    edge_cosine: np.float32
    near_m: np.float32


class PixelFilter(NamedTuple):
    """A camera with intrinsics as float32, and the limits of single precision for it. A parallel loop takes no nested
    tuples, so that the two are passed to it separately."""

    camera: Camera
    certainty: Certainty

    def at(self, T_camera_lidar: NDArray[np.float64]) -> Certainty:
        """The limits at a pose (4, 4)."""
        return self.certainty._replace(near_m=np.float32(max(NEAR_M, float(np.linalg.norm(T_camera_lidar[:3, 3])))))


@lru_cache(maxsize=32, typed=True)
def filter_of(camera: Camera) -> PixelFilter:
    """The filter of a camera, with its measured error bound.

    If no bound holds (an image of more than 16 million pixels, a formula that single precision cannot follow), every
    point is left to double precision.
    """
    single = in_single_precision(camera)
    edge = domain_angle_rad(camera)
    edge_cosine = np.float32(math.cos(edge))
    T, xyz = _sample(edge)
    error_px = _largest_error_px(camera, single, edge_cosine, T, T.astype(np.float32), xyz)
    countable = camera.width * camera.height < _MAX_PIXELS
    reach_px = max(0.5 - SAFETY * error_px, 0.0) if countable else 0.0
    return PixelFilter(single, Certainty(np.float32(reach_px), edge_cosine, np.float32(NEAR_M)))


def _sample(edge_rad: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """A pose (4, 4) and points (3, SAMPLES), LiDAR frame, all over the domain and a little beyond.

    The pose shifts by one metre and the points are one metre or more from the camera. This is the worst case that the
    kernel admits, because there the cancellation between a point's coordinates and the shift is largest.
    """
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.0, min(edge_rad + 0.02, math.pi), SAMPLES)
    near_edge = slice(0, SAMPLES, 8)
    theta[near_edge] = edge_rad + rng.uniform(-1e-3, 1e-3, SAMPLES // 8)
    phi = rng.uniform(-math.pi, math.pi, SAMPLES)
    distance_m = rng.uniform(1.0, 2.0, SAMPLES) ** rng.integers(0, 6, SAMPLES)
    p_camera = distance_m * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    # An arbitrary rotation without zeros: a quaternion of four unequal parts.
    w, x, y, z = np.array([0.7, -0.4, 0.5, -0.3]) / math.sqrt(0.99)
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = [0.6, -0.48, 0.64]
    return T, np.ascontiguousarray(T[:3, :3].T @ (p_camera - T[:3, 3:]), np.float32)


@njit(cache=True, error_model="numpy")
def _largest_error_px(
    camera: Camera, single: Camera, edge_cosine: np.float32, T: NDArray[np.float64], T32: NDArray[np.float32],
    xyz: NDArray[np.float32],
) -> float:  # fmt: skip
    """Largest difference between the two precisions in a coordinate of a point in the image. Infinite if they disagree,
    outside of the band around the edge of the domain, on whether there is a pixel."""
    largest = 0.0
    for i in range(xyz.shape[1]):
        x, y, z = float(xyz[0, i]), float(xyz[1, i]), float(xyz[2, i])
        x, y, z = moved(T, x, y, z)
        u, v, valid = project_point(camera, x, y, z)
        x32, y32, z32 = moved(T32, xyz[0, i], xyz[1, i], xyz[2, i])
        u32, v32, valid32 = image_point(single, x32, y32, z32)
        d = math.sqrt(x * x + y * y + z * z)
        if abs(z - edge_cosine * d) < 0.5 * EDGE_BAND * d:
            continue
        inside = valid and -1.0 < u < camera.width and -1.0 < v < camera.height
        inside32 = valid32 and -1.0 < u32 < camera.width and -1.0 < v32 < camera.height
        if inside or inside32:
            largest = max(largest, abs(u - u32), abs(v - v32)) if valid and valid32 else np.inf
    return largest


@njit(cache=True, error_model="numpy", fastmath=_LOOSE)
def certain_pixels(
    camera: Camera, limits: Certainty, T: NDArray[np.float32], x_m: NDArray[np.float32], y_m: NDArray[np.float32],
    z_m: NDArray[np.float32], pixel: NDArray[np.int32],
) -> np.int32:  # fmt: skip
    """Writes the pixel of each point (row · width + column), OUTSIDE or UNSURE into `pixel`; returns the largest entry.

    Args:
        camera, limits: the camera's filter, the limits at the pose.
        T: (4, 4) pose, LiDAR to camera.
        x_m, y_m, z_m: (n,) points, LiDAR frame.
        pixel: (n,) receives the pixels.
    """
    reach, edge_cosine, near_m = limits.reach_px, limits.edge_cosine, limits.near_m
    width, height = np.float32(camera.width), np.float32(camera.height)
    zero, not_in_image, unsure, far_m = np.float32(0.0), np.float32(NOT_IN_IMAGE), np.float32(UNSURE), np.float32(FAR_M)
    band = np.float32(EDGE_BAND)
    largest = np.int32(NOT_IN_IMAGE)
    # No branch, and nothing wider than 32 bits: with one 64-bit number or one count of truth values in this loop the
    # compiler uses registers of half the width (1.05 instead of 0.55 ns per point).
    for i in range(pixel.shape[0]):
        x, y, z = moved(T, x_m[i], y_m[i], z_m[i])
        u, v, in_domain = image_point(camera, x, y, z)
        # Far outside of the image a coordinate has no fraction left: clamp it to just outside.
        across = min(max(u + _HALF, -_HALF), width + _HALF)
        down = min(max(v + _HALF, -_HALF), height + _HALF)
        column, row = np.floor(across), np.floor(down)
        seen = in_domain & (column >= zero) & (row >= zero) & (column < width) & (row < height)
        d = math.sqrt(x * x + y * y + z * z)
        certain = (
            (abs(across - column - _HALF) < reach)
            & (abs(down - row - _HALF) < reach)
            & (abs(z - edge_cosine * d) > band * d)
            & (d > near_m)
            & (d < far_m)
        )
        index = row * width + column if seen else not_in_image
        pixel[i] = np.int32(index if certain else unsure)
        largest = max(largest, pixel[i])
    return largest


@njit(cache=True, error_model="numpy")
def exact_pixel(camera: Camera, T: NDArray[np.float64], x_m: float, y_m: float, z_m: float) -> int:
    """The pixel of one point (row · width + column) or OUTSIDE, in double precision."""
    x, y, z = moved(T, x_m, y_m, z_m)
    u, v, valid = project_point(camera, x, y, z)
    if not (valid and u >= -0.5 and v >= -0.5 and u < camera.width - 0.5 and v < camera.height - 0.5):
        return NOT_IN_IMAGE
    return int(v + 0.5) * camera.width + int(u + 0.5)


@njit(cache=True, inline="always")
def moved(T: NDArray[np.floating], x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point at a pose (4, 4), in the precision of both."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


FURTHEST_M = 1e4
"""Longest range taken: no LiDAR measures further, and nearer points cause no overflow."""


class InView(NamedTuple):
    """The points in view, in their original order.

    Attributes:
        uv_px: (n, 2) pixels, their centres at integers.
        range_m: (n,) from the LiDAR.
        which: (n,) indices into all points.
    """

    uv_px: NDArray[np.float64]
    range_m: NDArray[np.float64]
    which: NDArray[np.int64]


def points_in_view(
    camera: Camera,
    T_camera_lidar: NDArray[np.float64],
    xyz_m: NDArray[np.floating],
    mask: NDArray[np.bool_] | None,
    nearest_m: float,
) -> InView:
    """The points that lie in the image of a camera.

    Args:
        T_camera_lidar: (4, 4).
        xyz_m: (N, 3) LiDAR frame.
        mask: (height, width) or None; points on pixels that are False are left out.
        nearest_m: nearer points are on the vehicle itself and left out.

    Raises:
        ValueError: the points have another shape.
    """
    points_m = rows_of("xyz_m", xyz_m, 3)
    range_m = lengths(points_m)
    measured = np.flatnonzero((range_m >= nearest_m) & (range_m <= FURTHEST_M))
    points_m = points_m[measured]
    uv_px, valid = project(camera, points_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])
    seen = valid & in_image(camera, uv_px)
    if mask is not None:
        nearest = np.rint(uv_px[seen]).astype(np.int64)
        seen[np.flatnonzero(seen)[~mask[nearest[:, 1], nearest[:, 0]]]] = False
    which = measured[seen]
    return InView(uv_px[seen], range_m[which], which)


FIELD_OF_VIEW_PX = 8
"""Side of the squares of pixels at whose corners the field of view is measured: a few thousand rays, not a million."""

BUNDLE = 512
"""Points per bundle: their coordinates and pixels (8 kB) stay in the first-level cache while they are processed."""

SECTORS = 64
"""Sectors of azimuth by which a sweep is ordered. Each has 5.6 degrees, some three bundles of a 64-beam sweep."""

NEVER_OUT = -math.inf
"""Least cosine of a bundle that is never left out."""

MARGIN_RAD = 1e-6
"""Added to every angle, for rounding."""


def half_field_of_view_rad(camera: Camera, lit: NDArray[np.bool_]) -> float:
    """Largest angle from the optical axis at which the image has a pixel that counts (`lit`, (height, width)).

    Measured at the corners of the squares of pixels that hold such a pixel. If a corner has no ray, it is the end of
    the model's domain (the image circle of a fisheye lies inside the image).
    """
    rows, columns = (np.append(np.arange(0, size, FIELD_OF_VIEW_PX), size) for size in lit.shape)
    corners = np.stack(np.meshgrid(columns - 0.5, rows - 0.5), axis=-1)
    rays, valid = unproject(camera, corners.reshape(-1, 2))
    cosine = np.where(valid, rays[:, 2], -2.0).reshape(corners.shape[:2])
    least = np.minimum.reduce([cosine[:-1, :-1], cosine[:-1, 1:], cosine[1:, :-1], cosine[1:, 1:]])
    counts = np.logical_or.reduceat(np.logical_or.reduceat(lit, rows[:-1], axis=0), columns[:-1], axis=1)
    lowest = float(least[counts].min(initial=1.0))
    angle_rad = domain_angle_rad(camera) if lowest < -1.0 else math.acos(lowest)
    # One pixel more, for rounding and for the tangential distortion within a square.
    return angle_rad + 1.0 / min(camera.fx, camera.fy)


def within_cone(
    xyz_m: NDArray[np.float32], T_camera_lidar: NDArray[np.float64], angle_rad: float, shift_m: float
) -> NDArray[np.bool_]:
    """(N,) whether points (3, N) may lie within an angle of the optical axis of a camera, at a pose (4, 4) or at one
    shifted from it by up to `shift_m`. True for points that are not numbers."""
    x, y, z = xyz_m
    T = T_camera_lidar.astype(np.float32)
    a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    distance_m = np.maximum(np.sqrt(a * a + b * b + c * c), np.float32(1e-6))
    parallax_rad = np.arcsin(np.minimum(np.float32(shift_m) / distance_m, np.float32(1.0)))
    beyond: NDArray[np.bool_] = np.arccos(np.clip(c / distance_m, -1.0, 1.0)) > angle_rad + parallax_rad
    return ~beyond


@dataclass(frozen=True, slots=True, eq=False)
class Bundles:
    """The bundles of all frames, one after the other.

    Attributes:
        axis: (B, 3) unit vectors, LiDAR frame.
        least_cosine: (B,) a bundle is out of view if the z-component of its axis, turned into the camera frame, is
            less.
        shift_m: largest length of a pose's translation for which `least_cosine` holds.
    """

    axis: NDArray[np.float64]
    least_cosine: NDArray[np.float64]
    shift_m: float

    def least_cosine_at(self, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
        """(B,) `least_cosine` at a pose (4, 4); `NEVER_OUT` for all bundles if the pose shifts by more than
        `shift_m`."""
        if float(np.linalg.norm(T_camera_lidar[:3, 3])) > self.shift_m:
            return np.full(len(self.axis), NEVER_OUT)
        return self.least_cosine


def azimuth_order(xyz_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices (N,) that sort the points (N, 3) of a sweep by sector and keep their order within each sector."""
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
    sector = np.nan_to_num((azimuth + math.pi) * (SECTORS / (2.0 * math.pi))).astype(np.uint8)
    return np.argsort(sector, kind="stable")


def bundle(xyz_m: NDArray[np.float32], first_point: NDArray[np.int64], half_view_rad: float, shift_m: float) -> Bundles:
    """The bundles of points (3, N), frame f at first_point[f] to first_point[f + 1].

    Args:
        xyz_m: LiDAR frame.
        first_point: (F + 1,).
        half_view_rad: largest angle from the optical axis at which the image has a pixel.
        shift_m: largest length of a pose's translation.
    """
    # One frame at a time: in double precision, all frames at once would take more memory than anything else in a solve.
    frames = [_bundles_of_frame(xyz_m[:, a:b], half_view_rad, shift_m) for a, b in pairwise(first_point) if b > a]
    axes, least = zip(*frames, strict=True)
    return Bundles(np.concatenate(axes), np.concatenate(least), shift_m)


def _bundles_of_frame(
    xyz_m: NDArray[np.float32], half_view_rad: float, shift_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`axis` (B, 3) and `least_cosine` (B,) of the points (3, N) of one frame."""
    starts = np.arange(0, xyz_m.shape[1], BUNDLE)
    owner = np.arange(xyz_m.shape[1]) // BUNDLE
    range_m = np.maximum(np.sqrt(np.square(xyz_m, dtype=np.float64).sum(axis=0)), 1e-9)
    rays = xyz_m / range_m
    axis = np.add.reduceat(rays, starts, axis=1)
    axis /= np.maximum(np.sqrt(np.square(axis).sum(axis=0)), 1e-9)
    cosine = np.minimum.reduceat((rays * axis[:, owner]).sum(axis=0), starts)
    nearest_m = np.minimum.reduceat(range_m, starts)
    parallax = np.where(nearest_m > shift_m, np.arcsin(np.minimum(shift_m / nearest_m, 1.0)), math.pi)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) + parallax + half_view_rad + MARGIN_RAD
    # NaN compares as false: a bundle with a NaN, or one that reaches all around, is never left out.
    least = np.where(angle < math.pi, np.cos(np.minimum(angle, math.pi)), -2.0)
    return np.nan_to_num(axis.T.copy()), least
