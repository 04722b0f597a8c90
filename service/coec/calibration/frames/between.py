"""Thinned pairs between the chosen ones of a window. If the camera moved between two chosen pairs, which lie seconds
apart, these show when.

They enter no estimate, so they are not selected for quality, and a part of each sweep is enough. The part consists of
whole scan lines, so that the jumps in range along them are found as in the whole sweep.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, cos, pi, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.ports import ImageReducer
from coec.calibration.types import FramePair, LidarFrame, Matrix4
from coec.config import WindowConfig
from coec.errors import DecodeError
from coec.geometry.edges.scan_lines import BAND_RAD, distinct_rings

NS_PER_S_BETWEEN = 1_000_000_000
MIB = 2**20

POINTS = 12_000
"""About how many points of a sweep are kept. Among them are as many range edges as the search for a change uses of each
frame in a window of 25 (`search.change_point.POINTS`)."""

BEYOND_RAD = radians(6.0)
"""Points are kept so far beyond the border of the view, because a knock may bring them into view."""


@dataclass(slots=True)
class _ThinnedSlice:
    """The open slice. From the stamp `next_ns` on a pair lies far enough from those before it; None before the first
    pair. From the stamp `afforded_ns` on there are bytes for another pair."""

    start_ns: int
    length_ns: int
    spacing_ns: int
    max_bytes: int
    afforded_ns: int
    bytes: int = 0
    next_ns: int | None = None


class BetweenPairs:
    """Picks and thins the pairs between, slice by slice: at a given distance in seconds, within a given size."""

    def __init__(self, images: ImageReducer, half_view_rad: float) -> None:
        """`half_view_rad` is the largest angle from the optical axis at which the image has a pixel."""
        self._images = images
        self._half_view_rad = half_view_rad
        self._open: _ThinnedSlice | None = None

    def begin(self, config: WindowConfig, start_ns: int, length_ns: int) -> None:
        """Begins a slice that is cut by `config`. If its chosen pairs will be so near to each other that they show the
        time as well, it has no pairs between."""
        spacing_ns = round(config.between_s * NS_PER_S_BETWEEN)
        enabled = config.between_mib > 0 and length_ns >= 2 * spacing_ns * config.pairs
        self._open = (
            _ThinnedSlice(start_ns, length_ns, spacing_ns, config.between_mib * MIB, start_ns) if enabled else None
        )

    def on_selected(self, stamp_ns: int) -> None:
        """The window has chosen a pair of this stamp; the next pair between has to keep its distance from it."""
        if self._open is not None:
            self._open.next_ns = stamp_ns + self._open.spacing_ns

    def offer(self, pair: FramePair, T_camera_lidar: Matrix4) -> FramePair | None:
        """The pair, thinned, if it is to be recorded; `T_camera_lidar` (4, 4) is the current extrinsic."""
        current = self._open
        if current is None or current.next_ns is None or pair.stamp_ns < max(current.next_ns, current.afforded_ns):
            return None
        current.next_ns = pair.stamp_ns + current.spacing_ns
        try:
            camera = self._images.reduced(pair.camera)
        except DecodeError:
            return None
        lidar = thinned_sweep(pair.lidar, T_camera_lidar, self._half_view_rad)
        spent = current.bytes + len(camera.image.data) + _bytes(lidar)
        if spent > current.max_bytes:
            self._open = None
            return None
        current.bytes = spent
        # At any time no more than that time's share of the bytes is spent, so that they last to the end of the slice.
        current.afforded_ns = current.start_ns + current.length_ns * spent // current.max_bytes
        return replace(pair, camera=camera, lidar=lidar)


def thinned_sweep(lidar: LidarFrame, T_camera_lidar: Matrix4, half_view_rad: float) -> LidarFrame:
    """The sweep with about `POINTS` points: every n-th row of those in view, or nearly, at `T_camera_lidar` (4, 4).
    Without intensities."""
    seen = np.flatnonzero(_near_the_view(lidar.xyz_m, T_camera_lidar, half_view_rad + BEYOND_RAD))
    every = ceil(len(seen) / POINTS)
    if every > 1:
        seen = seen[_rows(lidar, seen) % every == 0]
    return replace(
        lidar,
        xyz_m=np.ascontiguousarray(lidar.xyz_m[seen]),
        intensity=None,
        ring=None if lidar.ring is None else lidar.ring[seen],
        time_offset_s=None if lidar.time_offset_s is None else lidar.time_offset_s[seen],
    )


def _near_the_view(xyz_m: NDArray[np.float32], T_camera_lidar: Matrix4, angle_rad: float) -> NDArray[np.bool_]:
    """(N,) whether points lie within an angle of the optical axis. It uses no compiled kernel and no BLAS, see
    `WindowCutter._points_in_view`."""
    if angle_rad >= pi:
        return np.ones(len(xyz_m), np.bool_)
    x_m, y_m, z_m = xyz_m.T
    T = T_camera_lidar.astype(np.float32)
    x, y, z = (T[i, 0] * x_m + T[i, 1] * y_m + T[i, 2] * z_m + T[i, 3] for i in range(3))
    return np.asarray(z >= np.float32(cos(angle_rad)) * np.sqrt(x * x + y * y + z * z))


def _rows(lidar: LidarFrame, of: NDArray[np.int64]) -> NDArray[np.int64]:
    """The row of each point: its ring, or, without rings, its band of elevation."""
    ring = distinct_rings(lidar.ring)
    if ring is not None:
        return ring[of].astype(np.int64)
    x_m, y_m, z_m = lidar.xyz_m[of].T
    elevation = np.arctan2(z_m, np.hypot(x_m, y_m))
    return np.asarray(np.floor(elevation / np.float32(BAND_RAD)).astype(np.int64))


def _bytes(lidar: LidarFrame) -> int:
    return sum(column.nbytes for column in (lidar.xyz_m, lidar.ring, lidar.time_offset_s) if column is not None)
