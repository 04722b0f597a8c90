"""When the camera moved within a window whose pairs lie seconds apart: asked of the thinned pairs between them.

The window tells a pose before and a pose after (`search.change_point`). A pair i that was taken before the change
scores higher at the one than at the other, by d_i = z_i(T_before) - z_i(T_after); one that was taken after it scores
lower. The likeliest time is where the sum of d over the pairs until then is highest (a change of known size: Page
1954), and every time at which that sum is nearly as high may be it, too.

Where a single pair of the window lies before the change, or after it, it tells its pose badly. So the pairs about the
change are searched for one, too, and of the poses that both tell those count that explain all pairs best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.edges import EdgeWitness
from coec.calibration.search.change_point import ChangePoint, change_point, scores
from coec.calibration.types import FramePair, Matrix4

MAY_BE = 4.0
"""By how much the sum may stay below the highest where the change may be: of 58 knocks of 0.5 to 3 degrees in five
simulated drives, one interval does not hold the knock then, and they are 1.7 s long in the mean (at 0 four do not)."""

AT_ONCE = 36
"""Pairs whose edges are found at a time: 120 MB of edge maps of 2 megapixels."""


@dataclass(frozen=True, slots=True, eq=False)
class DatedEdges:
    """The edge witness of some pairs, and their stamps, ascending."""

    stamps_ns: tuple[int, ...]
    edges: EdgeWitness


@dataclass(frozen=True, slots=True, eq=False)
class StepTime:
    """The camera moved between two stamps, from one pose (4, 4) to the other."""

    last_before_ns: int
    first_after_ns: int
    T_before: Matrix4
    T_after: Matrix4

    def holds(self, stamp_ns: int) -> bool:
        """Whether a pair of this stamp may narrow it."""
        return self.last_before_ns < stamp_ns < self.first_after_ns


def step_time(
    change: ChangePoint,
    window: DatedEdges,
    between: Sequence[FramePair],
    edges_of: Callable[[Sequence[FramePair]], DatedEdges | None],
) -> StepTime:
    """The stamps between which it moved, and the poses.

    Args:
        change: of the window.
        window: its pairs.
        between: the thinned pairs between them, ascending.
        edges_of: finds the edges of those of some pairs that have any; None if none has.
    """
    stamps_ns, seen, changes = window.stamps_ns, [window], [change]
    # One pair of the window further on either side: the poses were fitted to where the change was thought to be.
    first, last = max(0, change.first_late - 2), min(len(stamps_ns) - 1, change.first_late + 1)
    about, waiting = StepTime(stamps_ns[first], stamps_ns[last], change.T_before, change.T_after), list(between)
    while True:
        asked = [pair for pair in waiting if about.holds(pair.stamp_ns)]
        for some in _bunches(asked):
            found = edges_of(some)
            if found is not None:
                near = change_point(found.edges, _better_known(change, len(stamps_ns)))
                seen.append(found)
                changes += [] if near is None else [near]
        told = _told(seen, changes)
        if not asked:
            return told
        waiting = [pair for pair in waiting if not about.holds(pair.stamp_ns)]
        about = told


def _bunches(pairs: Sequence[FramePair]) -> Iterator[Sequence[FramePair]]:
    """`AT_ONCE` at most, all over the time that they take: any of them tells of a change anywhere."""
    count = -(-len(pairs) // AT_ONCE)
    return (pairs[begin::count] for begin in range(count))


def _better_known(change: ChangePoint, frames: int) -> Matrix4:
    """The pose (4, 4) of the side of a window that has more frames."""
    return change.T_before if 2 * change.first_late > frames else change.T_after


def _told(seen: Sequence[DatedEdges], changes: Sequence[ChangePoint]) -> StepTime:
    """Of all pairs, at the poses of those that explain them best. One pair at least lies on either side."""
    stamps_ns = np.concatenate([np.array(some.stamps_ns, np.int64) for some in seen])
    order = np.argsort(stamps_ns)
    stamps_ns = stamps_ns[order]

    def at(pose: Matrix4) -> NDArray[np.float64]:
        return np.concatenate([scores(some.edges.sharp, pose) for some in seen])[order]

    before = [(one.T_before, at(one.T_before)) for one in changes]
    after = [(one.T_after, at(one.T_after)) for one in changes]
    told, most = None, -np.inf
    for (T_before, early), (T_after, late) in product(before, after):
        # With the change at a split, what is before it scores at the one pose and the rest at the other.
        summed = late.sum() + np.cumsum(early - late)[:-1]
        highest = float(summed.max())
        if told is None or highest > most:
            may_be = np.flatnonzero(summed >= highest - MAY_BE)
            most = highest
            told = StepTime(int(stamps_ns[may_be[0]]), int(stamps_ns[may_be[-1] + 1]), T_before, T_after)
    assert told is not None, "there is a change"
    return told
