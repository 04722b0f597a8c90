"""The second witness: range edges of the sweeps on edges of the images, at several scales."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.values import FramePair, Rig
from coec.errors import CalibrationError
from coec.geometry.alignment import EdgeFrames
from coec.geometry.cameras import Camera, scaled
from coec.geometry.edge_charts import EdgeCharts, edge_charts
from coec.geometry.image_edges import BLUR_SIGMA_PX, edge_pyramid
from coec.geometry.projection import project
from coec.geometry.range_edges import range_edges

BANDS = 3
"""Bands of about 0.8, 0.4 and 0.2 degrees: the coarsest feels a pose 0.9 degrees away, the finest is sharp enough to
tell a true basin from a layout that happens to fit."""

MAX_PIXELS = 2_500_000
"""Images are halved until they have no more before the last search on them: bounded time, whatever the camera."""

COARSEST_BLUR_RAD = radians(0.6)
"""Least blur of the coarsest level, an angle about the optical axis and so the same for any lens; the levels double, so
it is below twice that. Wider, the layout of a scene hides the true pose (measured: in a garage the true pose comes 80th
of the cover at 1.9° and first to tenth at 0.9°); narrower, the cover of the global stage has to be finer."""

RANKED_POINTS = 60_000
"""Range edges of the window that rank basins, at most: bounded time for a window of many frames."""

THINNED_POINTS = 3_000
"""Range edges of the window that the cover visits; significance falls with the square root of their number only."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeWitness:
    """One witness in four forms.

    Attributes:
        sharp: every range edge on the image edges as they are, through the model of the lens: settles a pose.
        whole: the same on blurred edges: leads there.
        whole_blur_rad: its blur, an angle about the optical axis.
        bands: from fine to coarse, `RANKED_POINTS` evenly chosen range edges on one band each, through the model of the
            lens: ranks basins.
        band_blur_rad: the blur of each.
        charts: the coarsest and the next finer band with the same range edges: fast.
        thinned: the same with `THINNED_POINTS` evenly chosen range edges: faster.
    """

    sharp: EdgeFrames
    whole: EdgeFrames
    whole_blur_rad: float
    bands: tuple[EdgeFrames, ...]
    band_blur_rad: tuple[float, ...]
    charts: tuple[EdgeCharts, EdgeCharts]
    thinned: tuple[EdgeCharts, EdgeCharts]


def build_edges(
    pairs: Sequence[FramePair], clouds: Sequence[NDArray[np.float32]], greys: Sequence[NDArray[np.uint8]], rig: Rig
) -> EdgeWitness:
    """Range edges of the sweeps (found as measured, placed motion-compensated) and edge maps of the images.

    Args:
        pairs: the window's.
        clouds: (N_i, 3) float32, the sweeps of the pairs, motion-compensated.
        greys: (height, width) uint8, the images of the pairs.

    Raises:
        CalibrationError: no sweep has a range edge.
    """
    found = [range_edges(pair.lidar.xyz_m, pair.lidar.ring) for pair in pairs]
    first_point = np.concatenate([[0], np.cumsum([len(edges.index) for edges in found])]).astype(np.int64)
    if first_point[-1] == 0:
        raise CalibrationError("no sweep has a jump in range: there is nothing to lay onto the edges of the images")
    xyz_m = np.concatenate([cloud[edges.index] for cloud, edges in zip(clouds, found, strict=True)])
    lit = rig.mask if rig.mask is not None else np.ones((rig.camera.height, rig.camera.width), np.bool_)
    weight = np.concatenate([edges.weight for edges in found])
    finest, coarsest = _finest_level(rig.camera), _coarsest_level(rig.camera)
    finest = min(finest, coarsest + 1 - BANDS)
    pyramids = [edge_pyramid(grey, lit, finest, coarsest) for grey in greys]
    points_m = np.ascontiguousarray(xyz_m.T)

    def frames(level: int, maps: list[NDArray[np.float32]], chosen: NDArray[np.int64]) -> EdgeFrames:
        # Halving leaves out a last odd row or column: the scale is a half all the same.
        height, width = maps[0].shape
        camera = scaled(rig.camera, 0.5**level, 0.5**level)._replace(width=width, height=height)
        first_chosen = np.searchsorted(chosen, first_point)
        return EdgeFrames(
            camera, np.ascontiguousarray(points_m[:, chosen]), weight[chosen], first_chosen, np.stack(maps)
        )

    every, ranked = np.arange(len(weight)), _evenly(len(weight), RANKED_POINTS)
    levels = range(coarsest + 1 - BANDS, coarsest + 1)
    bands = tuple(frames(level, [pyramid.bands[level - finest] for pyramid in pyramids], ranked) for level in levels)
    blur_rad = tuple(_blur_rad(rig.camera, level) for level in levels)
    of_points = np.repeat(np.arange(len(pairs)), np.diff(first_point))[ranked]
    coarse, fine = (
        edge_charts(bands[k].camera, bands[k].maps, blur_rad[k], points_m[:, ranked], weight[ranked], of_points)
        for k in (-1, -2)
    )
    kept = _evenly(len(ranked), THINNED_POINTS)
    return EdgeWitness(
        sharp=frames(finest, [pyramid.sharp for pyramid in pyramids], every),
        whole=frames(finest, [pyramid.whole for pyramid in pyramids], every),
        whole_blur_rad=_blur_rad(rig.camera, finest),
        bands=bands,
        band_blur_rad=blur_rad,
        charts=(coarse, fine),
        thinned=(coarse.of_points(kept), fine.of_points(kept)),
    )


def _evenly(count: int, at_most: int) -> NDArray[np.int64]:
    """Indices of so many of `count` things, evenly chosen; of all where there are no more."""
    return np.unique(np.linspace(0, count - 1, min(count, at_most)).astype(np.int64))


def _finest_level(camera: Camera) -> int:
    """The first level of the pyramid that has no more than `MAX_PIXELS`."""
    return math.ceil(math.log2(max(1.0, camera.width * camera.height / MAX_PIXELS)) / 2.0)


def _coarsest_level(camera: Camera) -> int:
    """The first level of the pyramid that is blurred by `COARSEST_BLUR_RAD`, and no less than `BANDS` - 1."""
    return max(BANDS - 1, math.ceil(math.log2(COARSEST_BLUR_RAD / _blur_rad(camera, 0))))


def _blur_rad(camera: Camera, level: int) -> float:
    """Blur of a level, an angle about the optical axis; the focal length of a fisheye is not in pixels per radian."""
    (axis, aside), _ = project(camera, np.array([[0.0, 0.0, 1.0], [1e-3, 0.0, 1.0]]))
    return 2.0**level * BLUR_SIGMA_PX * 1e-3 / float(aside[0] - axis[0])
