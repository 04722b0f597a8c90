"""Culling of points that cannot be in view: once for a whole search, or in bundles of neighbours at each pose.

A bundle is a run of `BUNDLE` points of one frame. Seen from the LiDAR, its points lie in a cone: within some angle of
the bundle's axis. Seen from the camera, the cone is wider by their parallax. If the cone misses the field of view, none
of the points is in the image, and they are neither read nor projected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, domain_angle_rad
from coec.geometry.projection import unproject

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
    frames = [_of_frame(xyz_m[:, a:b], half_view_rad, shift_m) for a, b in pairwise(first_point) if b > a]
    axes, least = zip(*frames, strict=True)
    return Bundles(np.concatenate(axes), np.concatenate(least), shift_m)


def _of_frame(
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
