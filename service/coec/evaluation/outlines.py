"""Outlines of near objects as a LiDAR sees them: its range edges, joined from one scan line to the next.

A person compares lines with the image, not dots: the side of a car, a pole, the corner of a house. A range edge is
joined to the nearest one on the scan line above if both are equally far away and in nearly the same direction. A range
edge that is joined to nothing, mostly in foliage, belongs to no outline.
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
"""Elevation from a range edge to the one above it: more than the noise of one scan line, no more than the spacing of a
LiDAR of 16 beams (data sheet of the VLP-16: 2 degrees)."""

SAME_AZIMUTH_RAD = radians(0.6)
"""Azimuth between the two, at most: two columns of a slow sensor."""

ALIKE_SHARE = 0.03
"""Ranges along one outline differ from line to line by no more than this share of the range."""

BEND_RAD = radians(35.0)
"""An outline ends where it bends by more. Range edges jitter by a column, which is a quarter to half of the way to the
next line (HDL-64: 0.17 and 0.4 degrees)."""

COMPARED = 96
"""Each range edge is compared with so many next in azimuth: except in foliage, fewer lie within `ASIDE_RAD`."""


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """The range edges of a sweep.

    Attributes:
        xyz_m: (E, 3) float32, LiDAR frame, at the instant of the exposure.
        weight: (E,) float32, as `RangeEdges` has it.
        pieces: (L, 2) the lower and the upper edge of each piece of an outline.
        outline: (L,) the outline that each piece belongs to, as the index of its lowest edge.
    """

    xyz_m: NDArray[np.float32]
    weight: NDArray[np.float32]
    pieces: NDArray[np.int64]
    outline: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedOutlines:
    """Range edges in an image: (E, 2) pixels, and (E,) whether each lies in the image and not on the mask."""

    uv_px: NDArray[np.float64]
    seen: NDArray[np.bool_]


def outlines_of(pair: FramePair, rig: Rig, *, compensated: bool) -> Outlines:
    """The outlines of the sweep of a pair; none where the sweep has no jump in range."""
    edges = range_edges(pair.lidar.xyz_m, pair.lidar.ring)
    # Found as measured, placed motion-compensated, as the estimator does.
    xyz_m = compensate(pair, rig, enabled=compensated, selection=edges.index) + edges.shift_m
    joined = _joined(xyz_m)
    return Outlines(xyz_m, edges.weight, joined[:, :2], joined[:, 2])


def project_outlines(outlines: Outlines, rig: Rig, T_camera_lidar: Matrix4) -> ProjectedOutlines:
    """The range edges in the image at an extrinsic (4, 4)."""
    return _pixels(outlines.xyz_m, rig.camera, T_camera_lidar, rig.mask)


def _pixels(
    xyz_m: NDArray[np.float32], camera: Camera, T_camera_lidar: Matrix4, mask: NDArray[np.bool_] | None
) -> ProjectedOutlines:
    uv_px, valid = project(camera, xyz_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])
    seen = valid & in_image(camera, uv_px)
    if mask is not None:
        nearest = np.rint(uv_px[seen]).astype(np.int64)
        seen[np.flatnonzero(seen)[~mask[nearest[:, 1], nearest[:, 0]]]] = False
    return ProjectedOutlines(uv_px, seen)


def _joined(xyz_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """(L, 3): the two ends of each piece, and its outline."""
    seen = bearings(xyz_m)
    below, above = _mutual(seen)
    count = len(xyz_m)
    up, down = np.full(count, -1), np.full(count, -1)
    up[below], down[above] = above, below
    # An outline goes on where both its pieces have about the same direction.
    through = np.flatnonzero((up >= 0) & (down >= 0))
    direction = np.zeros((count, 2))
    direction[below, 0] = seen.azimuth[above] - seen.azimuth[below]
    direction[below, 1] = seen.elevation[above] - seen.elevation[below]
    ahead, behind = direction[through], direction[down[through]]
    cosine = (ahead * behind).sum(axis=1) / np.hypot(*ahead.T) / np.hypot(*behind.T)
    goes_on = np.zeros(count, np.bool_)
    goes_on[through[cosine >= cos(BEND_RAD)]] = True
    connected = goes_on[below] | goes_on[above]
    below, above = below[connected], above[connected]
    # The lowest edge of each outline: where no piece arrives from below, or the one that does bends too much.
    lowest = np.arange(count)
    for lower in below[np.argsort(seen.elevation[below], kind="stable")]:
        if goes_on[lower]:
            lowest[lower] = lowest[down[lower]]
    return np.column_stack([below, above, lowest[below]])


def _mutual(seen: Bearings) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (lower, upper) of mutually nearest edges: the upper is the nearest of all above the lower, and the lower
    the nearest of all below the upper."""
    order = np.argsort(seen.azimuth, kind="stable")
    azimuth, elevation, range_m = seen.azimuth[order], seen.elevation[order], seen.range_m[order]
    lower, upper, distances = [], [], []
    for step in range(1, min(COMPARED, len(order) - 1) + 1):
        near = azimuth[step:] - azimuth[:-step] <= SAME_AZIMUTH_RAD
        if not near.any():
            break
        rise = elevation[step:] - elevation[:-step]
        alike = np.abs(range_m[step:] - range_m[:-step]) <= ALIKE_SHARE * range_m[:-step]
        first = np.flatnonzero(near & alike & (np.abs(rise) >= NEXT_LINE_RAD[0]) & (np.abs(rise) <= NEXT_LINE_RAD[1]))
        is_above = rise[first] > 0
        lower.append(np.where(is_above, first, first + step))
        upper.append(np.where(is_above, first + step, first))
        distances.append(np.hypot(rise[first], azimuth[first + step] - azimuth[first]))
    if not lower:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    below, above, distance = np.concatenate(lower), np.concatenate(upper), np.concatenate(distances)
    both = np.intersect1d(_nearest(below, distance), _nearest(above, distance))
    return order[below[both]], order[above[both]]


def _nearest(group: NDArray[np.int64], distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """The index with the least distance in each group."""
    by_distance = np.lexsort((distance, group))
    return by_distance[np.unique(group[by_distance], return_index=True)[1]]
