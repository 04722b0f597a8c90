"""Finds when the camera moved within a window whose pairs lie seconds apart, from the thinned pairs between them.

The window gives a pose before and a pose after the change (`search.change_point`). A pair i from before the change
scores higher at the former than at the latter, by d_i = z_i(T_before) - z_i(T_after); a pair from after it scores
lower. The likeliest time is where the sum of d over the pairs until then is highest (a change of known size: Page
1954). Every time at which the sum is nearly as high is possible, too.

If a single pair of the window lies before or after the change, that pair determines its pose badly. So the pairs around
the change are also searched for a change, and of all poses found those are taken that explain all pairs best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.edges import EdgeCue
from coec.calibration.search.change_point import ChangePoint, change_point, scores
from coec.calibration.types import FramePair, Matrix4

MAY_BE = 4.0
"""The change may be wherever the sum is at most this far below its highest value. Of 58 knocks of 0.5 to 3 degrees in
five simulated drives one lies outside the interval, and intervals are 1.7 s long on average (at 0 four lie outside)."""

AT_ONCE = 36
"""Most pairs whose edges are found at a time: 120 MB of edge maps of 2 megapixels."""


@dataclass(frozen=True, slots=True, eq=False)
class DatedEdges:
    """The edge witness of some pairs, and their stamps, ascending."""

    stamps_ns: tuple[int, ...]
    edges: EdgeCue


@dataclass(frozen=True, slots=True, eq=False)
class StepTime:
    """The camera moved between two stamps, from one pose (4, 4) to the other."""

    last_before_ns: int
    first_after_ns: int
    T_before: Matrix4
    T_after: Matrix4

    def holds(self, stamp_ns: int) -> bool:
        """Whether a pair of this stamp may narrow the interval."""
        return self.last_before_ns < stamp_ns < self.first_after_ns


def step_time(
    change: ChangePoint,
    window: DatedEdges,
    between: Sequence[FramePair],
    edges_of: Callable[[Sequence[FramePair]], DatedEdges | None],
) -> StepTime:
    """The stamps between which the camera moved, and the poses before and after.

    Args:
        change: the change of the window.
        window: the pairs of the window.
        between: the thinned pairs between them, ascending.
        edges_of: finds the edges of those of some pairs that have any; None if none has.
    """
    stamps_ns, seen, changes = window.stamps_ns, [window], [change]
    # One more pair of the window on either side, because the poses were fitted to the supposed time of the change.
    first, last = max(0, change.first_late - 2), min(len(stamps_ns) - 1, change.first_late + 1)
    about, waiting = StepTime(stamps_ns[first], stamps_ns[last], change.T_before, change.T_after), list(between)
    while True:
        requested = [pair for pair in waiting if about.holds(pair.stamp_ns)]
        for some in _bunches(requested):
            dated = edges_of(some)
            if dated is not None:
                near = change_point(dated.edges, _better_known(change, len(stamps_ns)))
                seen.append(dated)
                changes += [] if near is None else [near]
        best = _best_step_time(seen, changes)
        if not requested:
            return best
        waiting = [pair for pair in waiting if not about.holds(pair.stamp_ns)]
        about = best


def _bunches(pairs: Sequence[FramePair]) -> Iterator[Sequence[FramePair]]:
    """Bunches of at most `AT_ONCE` pairs, each spread over the whole time, so that each shows a change anywhere."""
    count = -(-len(pairs) // AT_ONCE)
    return (pairs[begin::count] for begin in range(count))


def _better_known(change: ChangePoint, frames: int) -> Matrix4:
    """The pose (4, 4) of the side of a window that has more frames."""
    return change.T_before if 2 * change.first_late > frames else change.T_after


def _best_step_time(seen: Sequence[DatedEdges], changes: Sequence[ChangePoint]) -> StepTime:
    """The time of the change by all pairs, at the two poses that explain them best. At least one pair lies on either
    side."""
    stamps_ns = np.concatenate([np.array(some.stamps_ns, np.int64) for some in seen])
    order = np.argsort(stamps_ns)
    stamps_ns = stamps_ns[order]

    def at(pose: Matrix4) -> NDArray[np.float64]:
        return np.concatenate([scores(some.edges.sharp, pose) for some in seen])[order]

    before = [(one.T_before, at(one.T_before)) for one in changes]
    after = [(one.T_after, at(one.T_after)) for one in changes]
    best, most = None, -np.inf
    for (T_before, early), (T_after, late) in product(before, after):
        # For each split: the pairs before it score at one pose and the rest at the other.
        summed = late.sum() + np.cumsum(early - late)[:-1]
        highest = float(summed.max())
        if best is None or highest > most:
            may_be = np.flatnonzero(summed >= highest - MAY_BE)
            most = highest
            best = StepTime(int(stamps_ns[may_be[0]]), int(stamps_ns[may_be[-1] + 1]), T_before, T_after)
    assert best is not None, "there is a change"
    return best
