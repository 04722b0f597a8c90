"""When the camera moved within a window whose pairs lie seconds apart: asked of the thinned pairs between them.

The poses before and after are known from the window (`search.change_point`). A pair i that was taken before the change
scores higher at the one than at the other, by d_i = z_i(T_before) - z_i(T_after); one that was taken after it scores
lower. The likeliest time is where the sum of d over the pairs until then is highest (a change of known size: Page
1954), and every time at which that sum is nearly as high may be it, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coec.calibration.search.change_point import ChangePoint, scores
from coec.calibration.types import FramePair
from coec.geometry.edges.alignment import EdgeFrames

MAY_BE = 6.0
"""By how much the sum may stay below the highest where the change may be."""

AT_ONCE = 32
"""Pairs whose edges are found at a time: 100 MB of edge maps of 2 megapixels."""


@dataclass(frozen=True, slots=True, eq=False)
class DatedEdges:
    """Range edges of some frames on the sharpest image edges, and the stamps of the frames."""

    stamps_ns: tuple[int, ...]
    sharp: EdgeFrames


@dataclass(frozen=True, slots=True)
class StepTime:
    """The camera moved between two stamps."""

    last_before_ns: int
    first_after_ns: int


def step_time(
    change: ChangePoint,
    window: DatedEdges,
    between: Sequence[FramePair],
    edges_of: Callable[[Sequence[FramePair]], DatedEdges | None],
) -> StepTime:
    """The stamps between which it moved.

    Args:
        change: of the window.
        window: its pairs, in their order.
        between: the thinned pairs between them.
        edges_of: finds the edges of those of some pairs that have any; None if none has.
    """
    favoured, stamps_ns = _favoured(window, change), window.stamps_ns
    # One pair of the window further on either side: the poses were fitted to where the change was thought to be.
    first, last = max(0, change.first_late - 2), min(len(stamps_ns) - 1, change.first_late + 1)
    asked = [pair for pair in between if stamps_ns[first] < pair.stamp_ns < stamps_ns[last]]
    waiting = {pair.stamp_ns: pair for pair in between}
    while True:
        for begin in range(0, len(asked), AT_ONCE):
            edges = edges_of(asked[begin : begin + AT_ONCE])
            if edges is not None:
                favoured |= _favoured(edges, change)
        for pair in asked:
            del waiting[pair.stamp_ns]
        told = _told(favoured)
        asked = [pair for pair in waiting.values() if told.last_before_ns < pair.stamp_ns < told.first_after_ns]
        if not asked:
            return told


def _told(favoured: Mapping[int, float]) -> StepTime:
    """Of pairs by their stamp, by how much each favours the pose before. One pair at least lies on either side."""
    stamps_ns = sorted(favoured)
    summed = np.cumsum([favoured[stamp_ns] for stamp_ns in stamps_ns])[:-1]
    may_be = np.flatnonzero(summed >= summed.max() - MAY_BE)
    return StepTime(stamps_ns[int(may_be[0])], stamps_ns[int(may_be[-1]) + 1])


def _favoured(edges: DatedEdges, change: ChangePoint) -> dict[int, float]:
    """By stamp, how much a frame favours the pose before."""
    apart = scores(edges.sharp, change.T_before) - scores(edges.sharp, change.T_after)
    return dict(zip(edges.stamps_ns, apart.tolist(), strict=True))
