"""The second witness: range edges of the sweeps on edges of the images, at several scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coec.calibration.values import FramePair, Rig
from coec.errors import CalibrationError
from coec.geometry.alignment import EdgeFrames
from coec.geometry.cameras import scaled
from coec.geometry.image_edges import edge_pyramid
from coec.geometry.range_edges import range_edges

LEVELS = 4
"""Blur of 2, 4, 8 and 16 px of the image: the coarsest still sees a pose 1.5° away, the finest settles to 0.05°."""

THINNED_POINTS = 400
"""Range edges per frame that the global stage visits; significance falls with its square root only."""

MAX_IMAGE_PIXELS = 2_500_000
"""Above, images are halved first: the blur would be below the width of any edge of such an image."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeWitness:
    """`levels` from fine to coarse with every range edge, `thinned` the same with `THINNED_POINTS` per frame."""

    levels: tuple[EdgeFrames, ...]
    thinned: tuple[EdgeFrames, ...]


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
    pyramids = [edge_pyramid(grey, lit, _first_level(grey) + LEVELS) for grey in greys]
    skipped = _first_level(greys[0])
    levels = []
    for k in range(skipped, skipped + LEVELS):
        maps = np.stack([pyramid.levels[k] for pyramid in pyramids])
        # Halving leaves out a last odd row or column: the scale is a half all the same.
        camera = scaled(rig.camera, 0.5**k, 0.5**k)._replace(width=maps.shape[2], height=maps.shape[1])
        weight = np.concatenate([edges.weight for edges in found])
        levels.append(EdgeFrames(camera, np.ascontiguousarray(xyz_m.T), weight, first_point, maps))
    return EdgeWitness(tuple(levels), tuple(_thinned(level) for level in levels))


def _first_level(grey: NDArray[np.uint8]) -> int:
    return 1 if grey.size > MAX_IMAGE_PIXELS else 0


def _thinned(frames: EdgeFrames) -> EdgeFrames:
    """Evenly chosen edges of each frame, at most `THINNED_POINTS`."""
    chosen = [
        begin + (np.arange(min(end - begin, THINNED_POINTS)) * (end - begin)) // min(end - begin, THINNED_POINTS)
        for begin, end in zip(frames.first_point[:-1], frames.first_point[1:], strict=True)
        if end > begin
    ]
    counts = np.minimum(np.diff(frames.first_point), THINNED_POINTS)
    index = np.concatenate(chosen)
    return replace(
        frames,
        xyz_m=np.ascontiguousarray(frames.xyz_m[:, index]),
        weight=frames.weight[index],
        first_point=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
    )
