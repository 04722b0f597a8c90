"""Runs the kernels that a solve uses after finding its edges, each once on tiny inputs, so that they are compiled
before a solve needs them. They take half of the compiling time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.search.global_search import sample_reach
from coec.geometry.cameras import Camera, scaled
from coec.geometry.edges.alignment import (
    EdgeFrames,
    alignment_of_parts,
    alignments,
    alignments_of_late,
    significances,
)
from coec.geometry.edges.charts import charted_significances, edge_charts, pattern_search, select_separated
from coec.geometry.edges.climbs import AscentStart, ascend
from coec.geometry.mutual_information import BinnedFrames, information_of_each, mutual_information
from coec.geometry.projection import project
from coec.geometry.shares import share_of_pixels

LATE_CAMERA_PX = 64
"""Longer side of the image: kernels are compiled for types, not for sizes."""

BLUR_RAD = 0.1
"""Blur that gives a chart of few cells, rad."""


def late_kernels(camera: Camera) -> tuple[Callable[[], object], ...]:
    """The functions to run; those that a solve needs last come first."""
    scale = min(1.0, LATE_CAMERA_PX / max(camera.width, camera.height))
    camera = scaled(camera, scale, scale)
    edges, pose = one_edge(camera), np.eye(4)
    two, point = np.stack([pose, pose]), np.zeros((3, 1), np.float32)
    charts = edge_charts(camera, edges.maps, BLUR_RAD, edges.xyz_m, edges.weight, np.zeros(1, np.int64))
    steps, reach = np.full(6, 0.01), np.array([0.01, 0.01])
    binned = _binned(camera)
    values = np.ones((camera.height, camera.width), np.float32)
    return (
        lambda: ascend(edges, [AscentStart(pose, 0, 1)], pose[None, None]),
        lambda: alignments_of_late(edges, point, point, point.T, two),
        lambda: pattern_search(charts, two, steps, 1, pose, reach),
        lambda: charted_significances(charts, two),
        lambda: information_of_each(binned, two),
        lambda: mutual_information(binned, pose),
        lambda: share_of_pixels(values, values > 0.0, np.ones(1, np.float32)),
        lambda: significances(edges, two),
        lambda: sample_reach(pose, SearchBox(0.1, 0.0), 8),
        lambda: select_separated(two, np.arange(2), 1, 3.0),
        lambda: alignments(edges, two),
        lambda: alignment_of_parts(edges, np.zeros(1, np.uint8), 1, two),
        lambda: project(camera, np.ones((1, 3))),
    )


def one_edge(camera: Camera) -> EdgeFrames:
    """Input with one range edge, and an image without edges."""
    maps = np.zeros((1, camera.height, camera.width), np.int8)
    return EdgeFrames(camera, np.ones((3, 1), np.float32), np.ones(1, np.float32), np.array([0, 1]), maps)


def _binned(camera: Camera) -> BinnedFrames:
    """Input with one point, and an image of a single depth."""
    return BinnedFrames(
        camera=camera,
        xyz_m=np.ones((3, 1), np.float32),
        range_bin=np.zeros(1, np.uint8),
        first_point=np.array([0, 1]),
        depth_bin=np.zeros((1, camera.height * camera.width + 1), np.uint8),
        depth_bins=1,
        range_bins=1,
    )
