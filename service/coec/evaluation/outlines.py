"""Outlines of near things as a LiDAR tells them: its range edges, one scan line joined to the next.

What a person compares with the image is a line, not a dot: the side of a car, a pole, the corner of a house. A range
edge is joined to the nearest one of the scan line above if that is as far away and in nearly the same direction; what
is joined to nothing, foliage mostly, is no outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import FramePair, Matrix4, Rig
from coec.geometry.bearings import Bearings, bearings
from coec.geometry.cameras import Camera, in_image
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.projection import project

NEXT_LINE_RAD = (radians(0.05), radians(2.2))
"""Elevations between a range edge and the one above it: more than the noise of one scan line, no more than the spacing
of a LiDAR of 16 beams (data sheet of the VLP-16: 2 degrees)."""

ASIDE_RAD = radians(0.6)
"""Azimuth between them, at most: two columns of a slow sensor."""

ALIKE_SHARE = 0.03
"""Ranges of one outline differ from line to line by no more than this share of them."""

BEND_RAD = radians(35.0)
"""Where an outline bends by more, it ends: range edges jitter by a column, which is a quarter to half of the way to the
next line (HDL-64: 0.17 and 0.4 degrees)."""

COMPARED = 96
"""Range edges next in azimuth that each is compared with: within `ASIDE_RAD` there are fewer, but in foliage."""


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """The range edges of a sweep.

    Attributes:
        xyz_m: (E, 3) float32, LiDAR frame, at the instant of the exposure.
        weight: (E,) float32, as `RangeEdges` has it.
        pieces: (L, 2) the lower and the upper edge of each piece of an outline.
        outline: (L,) to which each belongs: its lowest edge.
    """

    xyz_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    pieces: NDArray[np.int64]
    outline: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Where a camera has edges: (E, 2) pixels, and (E,) whether there is a pixel that counts."""

    uv_px: NDArray[np.float64]
    seen: NDArray[np.bool_]


def outlines_of(pair: FramePair, rig: Rig, *, compensated: bool) -> Outlines:
    """Those of the sweep of a pair; none where it has no jump in range."""
    found = range_edges(pair.lidar.xyz_m, pair.lidar.ring)
    # Found as measured, placed motion-compensated, as the estimator does.
    xyz_m = compensate(pair, rig, enabled=compensated, chosen=found.index) + found.shift_m
    joined = _joined(xyz_m)
    return Outlines(xyz_m, found.weight, joined[:, :2], joined[:, 2])


def drawn_at(outlines: Outlines, rig: Rig, T_camera_lidar: Matrix4) -> Drawn:
    """The range edges in the image at an extrinsic (4, 4)."""
    return _pixels(outlines.xyz_m, rig.camera, T_camera_lidar, rig.mask)


def _pixels(
    xyz_m: NDArray[np.float32], camera: Camera, T_camera_lidar: Matrix4, mask: NDArray[np.bool_] | None
) -> Drawn:
    uv_px, valid = project(camera, xyz_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])
    seen = valid & in_image(camera, uv_px)
    if mask is not None:
        nearest = np.rint(uv_px[seen]).astype(np.int64)
        seen[np.flatnonzero(seen)[~mask[nearest[:, 1], nearest[:, 0]]]] = False
    return Drawn(uv_px, seen)


def _joined(xyz_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """(L, 3): the two ends of each piece, and its outline."""
    seen = bearings(xyz_m)
    below, above = _mutual(seen)
    count = len(xyz_m)
    up, down = np.full(count, -1), np.full(count, -1)
    up[below], down[above] = above, below
    # Where an outline goes on: both pieces in about one direction.
    through = np.flatnonzero((up >= 0) & (down >= 0))
    direction = np.zeros((count, 2))
    direction[below, 0] = seen.azimuth[above] - seen.azimuth[below]
    direction[below, 1] = seen.elevation[above] - seen.elevation[below]
    ahead, behind = direction[through], direction[down[through]]
    cosine = (ahead * behind).sum(axis=1) / np.hypot(*ahead.T) / np.hypot(*behind.T)
    goes_on = np.zeros(count, np.bool_)
    goes_on[through[cosine >= cos(BEND_RAD)]] = True
    kept = goes_on[below] | goes_on[above]
    below, above = below[kept], above[kept]
    # The lowest edge of each: where nothing comes from below, or what comes is bent.
    lowest = np.arange(count)
    for lower in below[np.argsort(seen.elevation[below], kind="stable")]:
        if goes_on[lower]:
            lowest[lower] = lowest[down[lower]]
    return np.column_stack([below, above, lowest[below]])


def _mutual(seen: Bearings) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of edges that are next to each other: of all above the one, the nearest is the other, and of all below the
    other, the nearest is the one."""
    order = np.argsort(seen.azimuth, kind="stable")
    azimuth, elevation, range_m = seen.azimuth[order], seen.elevation[order], seen.range_m[order]
    lower, upper, apart = [], [], []
    for step in range(1, min(COMPARED, len(order) - 1) + 1):
        near = azimuth[step:] - azimuth[:-step] <= ASIDE_RAD
        if not near.any():
            break
        rise = elevation[step:] - elevation[:-step]
        alike = np.abs(range_m[step:] - range_m[:-step]) <= ALIKE_SHARE * range_m[:-step]
        first = np.flatnonzero(near & alike & (np.abs(rise) >= NEXT_LINE_RAD[0]) & (np.abs(rise) <= NEXT_LINE_RAD[1]))
        is_above = rise[first] > 0
        lower.append(np.where(is_above, first, first + step))
        upper.append(np.where(is_above, first + step, first))
        apart.append(np.hypot(rise[first], azimuth[first + step] - azimuth[first]))
    if not lower:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    below, above, distance = np.concatenate(lower), np.concatenate(upper), np.concatenate(apart)
    both = np.intersect1d(_nearest(below, distance), _nearest(above, distance))
    return order[below[both]], order[above[both]]


def _nearest(group: NDArray[np.int64], distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """Of each group the index with the least distance."""
    by_distance = np.lexsort((distance, group))
    return by_distance[np.unique(group[by_distance], return_index=True)[1]]
