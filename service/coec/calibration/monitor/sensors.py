"""What a check needs of each sensor by itself: every sweep and every image is prepared once, however many pairs of a
rig use it.

Resolutions: the sharpest edges decide and are read at the camera's own resolution (halved only above `MAX_PIXELS`), so
images are decoded in full. Bands are two pixels wide and read at full, half and quarter resolution. A depth network
reads fewer pixels and decodes for itself. Edges of an image are needed only where range edges can lie: a thousand of
the 114,000 points of a sweep, in a strip of a fifth of a fisheye's image.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.facts import picture_facts, sweep_facts
from coec.calibration.monitor.sensor_faults import PictureFacts, SweepFacts
from coec.calibration.types import LidarFrame, Matrix4
from coec.errors import CalibrationError
from coec.geometry.bearings import bearings
from coec.geometry.cameras import Camera, cropped, in_image, pixel_rad, scaled
from coec.geometry.cover import moved_by
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, MEAN_RADIUS_PX, EdgeScales, Rectangle
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.projection import project
from coec.geometry.thinning import thinned

MAX_PIXELS = 2_500_000
"""Images are halved until they have no more pixels than this, which bounds the time for any camera."""

COARSEST_BLUR_RAD = radians(0.6)
"""Least blur of the coarsest band, an angle about the optical axis; the blur is below twice that. The hills of the band
are then wide enough for a cover of some hundred poses within reach."""

OUTLINE_RAD = radians(2.0)
"""Within this turn of the camera the range edges have to stay on the prepared part of its images, all but a few. After
a larger turn some of them lie beyond its rim, but enough lie on it to show the turn."""

OUTLINE_POINTS, OUTLINE_SHARE = 1_500, 0.01
"""Range edges from which the prepared part is found, and the share of them that may lie beyond it on each side: without
that share a post next to the vehicle would double the part."""

MARGIN_PX = MEAN_RADIUS_PX + 8
"""Margin by which the prepared part is larger: the reach of a local mean, and of a blur."""


@dataclass(frozen=True, slots=True, eq=False)
class PreparedSweep:
    """A sweep of one LiDAR.

    Attributes:
        edges: the sweep reduced to its range edges, as measured.
        weight: (E,) float32, weight of each range edge; see `RangeEdges`.
        facts: what the sweep shows of the sensor itself.
    """

    edges: LidarFrame
    weight: NDArray[np.float32]
    facts: SweepFacts


@dataclass(frozen=True, slots=True, eq=False)
class MapLevel:
    """Edge maps of the images of one camera at one level: `maps` (F, h, w) int8 as in `EdgePyramid`, `camera` the
    intrinsics of what they cover, `blur_rad` their blur, an angle about the optical axis."""

    camera: Camera
    blur_rad: float
    maps: NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class PreparedImages:
    """The images of one camera.

    Attributes:
        facts: what each shows of the camera itself.
        sharp, whole: as in `EdgePyramid`.
        bands: likewise, from fine to coarse; at least two.
    """

    facts: tuple[PictureFacts, ...]
    sharp: MapLevel
    whole: MapLevel
    bands: tuple[MapLevel, ...]


def prepare_sweep(sweep: LidarFrame) -> PreparedSweep:
    """The range edges of a sweep, and what the sweep shows of the LiDAR. Only these points are placed, and only later,
    because every pair places them at the instant of another exposure."""
    seen = bearings(sweep.xyz_m)
    detected = range_edges(sweep.xyz_m, sweep.ring, seen)
    offsets_s = None if sweep.time_offset_s is None else sweep.time_offset_s[detected.index]
    # The shift may come before motion compensation, which turns this tenth of a degree by two degrees at most.
    xyz_m = sweep.xyz_m[detected.index] + detected.shift_m
    edges = LidarFrame(sweep.stamp_ns, sweep.frame_id, xyz_m, time_offset_s=offsets_s)
    return PreparedSweep(edges, detected.weight, sweep_facts(sweep.xyz_m, seen, len(detected.index)))


def outline(camera: Camera, edges: Sequence[LidarFrame], pose: Matrix4, reach_rad: float) -> Rectangle | None:
    """The part of the image in which range edges can lie at poses within `reach_rad` of a pose (4, 4); None if none
    can."""
    xyz_m = np.concatenate([sweep.xyz_m for sweep in edges])
    xyz_m = xyz_m[thinned(len(xyz_m), OUTLINE_POINTS)].astype(np.float64)
    turns_rad = reach_rad * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    # A point that can reach the rim of the strip is at the rim at one of these poses.
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for turned in moved_by(np.ascontiguousarray(pose), turns_rad, np.zeros_like(turns_rad)):
        uv_px, valid = project(camera, xyz_m @ turned[:3, :3].T + turned[:3, 3])
        uv_px = uv_px[valid]
        uv_px = np.sort(uv_px[in_image(camera, uv_px)], axis=0)
        if len(uv_px):
            beyond = int(OUTLINE_SHARE * len(uv_px))
            low, high = np.minimum(low, uv_px[beyond]), np.maximum(high, uv_px[-1 - beyond])
    if not np.isfinite(low).all():
        return None
    left, top = np.maximum(np.floor(low).astype(int), 0).tolist()
    right, bottom = np.minimum(np.ceil(high).astype(int) + 1, (camera.width, camera.height)).tolist()
    return Rectangle(left, top, right - left, bottom - top)


def prepare_images(
    greys: Iterable[NDArray[np.uint8]],
    frames: int,
    camera: Camera,
    mask: NDArray[np.bool_] | None,
    upright: NDArray[np.float64],
    counted: Rectangle,
    required: Rectangle,
) -> PreparedImages:
    """Edge maps of the images of a camera, and what they show of the camera. Images are read one at a time, so `greys`
    (height, width) may decode each when it is asked for.

    Args:
        frames: how many images there are.
        mask: (height, width), False = ignore this pixel; None: all count.
        upright: (2,) direction of the LiDAR's axis in the image, see `EdgeScales`; with several LiDARs, that of any.
        counted: the part of the image in which range edges lie: its mean and deviation are the units of the maps.
        wanted: the part on which edges are needed; it contains `counted`.

    Raises:
        CalibrationError: an image is not of the camera's size.
    """
    finest = math.ceil(math.log2(max(1.0, camera.width * camera.height / MAX_PIXELS)) / 2.0)
    coarsest = max(finest + 1, math.ceil(math.log2(COARSEST_BLUR_RAD / (BLUR_SIGMA_PX * pixel_rad(camera)))))
    part = _aligned(required, camera, 2 << coarsest)
    lit = np.ones((part.height, part.width), np.bool_) if mask is None else np.ascontiguousarray(mask[part.slices])
    scales = EdgeScales(lit, finest, coarsest, upright, counted.within(part))
    facts: list[PictureFacts] = []
    stacks: list[NDArray[np.int8]] = []
    for frame, grey in enumerate(greys):
        if grey.shape != (camera.height, camera.width):
            (height, width) = grey.shape
            raise CalibrationError(
                f"an image has {width} x {height} px, the camera model {camera.width} x {camera.height} px"
            )
        facts.append(picture_facts(grey))
        pyramid = scales.pyramid(np.ascontiguousarray(grey[part.slices]))
        maps = (pyramid.sharp, pyramid.whole, *pyramid.bands)
        stacks = stacks or [np.empty((frames, *level.shape), np.int8) for level in maps]
        for stack, level_map in zip(stacks, maps, strict=True):
            stack[frame] = level_map
    of_part = cropped(camera, part.left, part.top, part.width, part.height)

    def level(number: int, blurred: int, maps: NDArray[np.int8]) -> MapLevel:
        # Halving drops a last odd row or column, but the scale is still a half.
        _, height, width = maps.shape
        seen_by = scaled(of_part, 0.5**number, 0.5**number)._replace(width=width, height=height)
        return MapLevel(seen_by, 2.0**blurred * BLUR_SIGMA_PX * pixel_rad(camera), maps)

    sharp, whole, *bands = stacks
    return PreparedImages(
        facts=tuple(facts),
        sharp=level(finest, finest, sharp),
        whole=level(finest + 1, finest, whole),
        bands=tuple(level(finest + k, finest + k, maps) for k, maps in enumerate(bands)),
    )


def union(parts: Sequence[Rectangle]) -> Rectangle:
    """The smallest part that contains all of the given parts, for several LiDARs that use one camera."""
    left, top = min(part.left for part in parts), min(part.top for part in parts)
    right = max(part.left + part.width for part in parts)
    bottom = max(part.top + part.height for part in parts)
    return Rectangle(left, top, right - left, bottom - top)


def _aligned(part: Rectangle, camera: Camera, step_px: int) -> Rectangle:
    """The part with a margin, within the image, begun at a pixel at which a pixel of every level begins."""
    left, top = (max(begin - MARGIN_PX, 0) // step_px * step_px for begin in (part.left, part.top))
    right = min(part.left + part.width + MARGIN_PX, camera.width)
    bottom = min(part.top + part.height + MARGIN_PX, camera.height)
    return Rectangle(left, top, right - left, bottom - top)
