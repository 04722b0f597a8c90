"""Bundles of neighbouring points of a sweep, so that a pose can leave out a bundle as a whole.

A bundle is a run of `BUNDLE` points of one frame. Seen from the LiDAR its points lie within an angle of its axis; seen
from the camera, within that angle and their parallax. Where this cone and the field of view do not meet, none of them
is in the image: they are neither read nor projected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

BUNDLE = 512
"""Points per bundle: their coordinates and pixels (8 kB) stay in the first-level cache while they are dealt with."""

SECTORS = 64
"""Sectors of azimuth by which a sweep is ordered: of 5.6 degrees, some three bundles of a 64-beam sweep each."""

MARGIN_RAD = 1e-6
"""Added to every angle, for rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Bundles:
    """The bundles of all frames, one after the other.

    Attributes:
        axis: (B, 3) unit vectors, LiDAR frame.
        least_cosine: (B,) a bundle is out of view where the z-component of its axis, turned into the camera frame, is
            less.
        shift_m: largest length of the pose's translation for which that holds.
    """

    axis: NDArray[np.float64]
    least_cosine: NDArray[np.float64]
    shift_m: float

    def at(self, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(B,) whether a bundle may be in view at a pose (4, 4)."""
        if float(np.linalg.norm(T_camera_lidar[:3, 3])) > self.shift_m:
            return np.ones(len(self.axis), np.bool_)
        a, r = self.axis, T_camera_lidar[2]
        seen: NDArray[np.bool_] = a[:, 0] * r[0] + a[:, 1] * r[1] + a[:, 2] * r[2] >= self.least_cosine
        return seen


def azimuth_order(xyz_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices (N,) that bring the points (N, 3) of a sweep into order of their sector, else as they were."""
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
    # A frame at a time: in double precision, all at once would be the most that a solve ever holds.
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
    # NaN compares as false: a bundle with a point that is no number, or that reaches all around, is never left out.
    least = np.where(angle < math.pi, np.cos(np.minimum(angle, math.pi)), -2.0)
    return np.nan_to_num(axis.T.copy()), least
