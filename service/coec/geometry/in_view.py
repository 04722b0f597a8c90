"""Which points of a sweep a camera sees, and where in its image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera, in_image
from coec.geometry.projection import project
from coec.geometry.vectors import lengths, rows_of

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
