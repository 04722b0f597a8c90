"""Counts the frames of a stream that were lost on their way, by gaps in their numbers.

A missing number counts as lost once it is late, because a frame that was only overtaken comes within a few others. An
overtaken frame is no loss of the network: if it is dropped later, the part that drops it counts it, once.
"""

from __future__ import annotations

MAX_GAP = 100_000
"""A larger step means that the sender counts anew: at 100 Hz this gap would be a quarter of an hour of loss."""

LATE_FRAMES = 16
"""How many frames may overtake another: 1.6 s at 10 Hz, the depth of the inbox."""


class SequenceNumbers:
    """The numbers of one sender; one thread uses it."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._missing: set[int] = set()
        self._counted = 0
        self._since_counted = 0

    def counted(self) -> None:
        """A frame came, was lost in this process, and has been counted already, so its gap is not counted again. The
        frame may have had no number at all; therefore only a gap soon afterwards is taken for its gap."""
        self._counted += 1
        self._since_counted = 0

    def lost_by(self, number: int) -> int:
        """How many frames are now known to be lost on their way, given that this number has come."""
        lost = self._left_out_by(number)
        known = min(lost, self._counted)
        self._since_counted += 1
        self._counted = 0 if self._since_counted > 2 * LATE_FRAMES else self._counted - known
        return lost - known

    def _left_out_by(self, number: int) -> int:
        newest = self._newest
        if newest is not None and newest - LATE_FRAMES <= number <= newest:  # late, or for the second time
            self._missing.discard(number)
            return 0
        self._newest = number
        if newest is None or not newest < number <= newest + MAX_GAP:
            # The sender counts anew: numbers that are missing from the old count do not come any more.
            lost = len(self._missing)
            self._missing.clear()
            return lost
        oldest = number - LATE_FRAMES
        self._missing.update(range(max(newest + 1, oldest), number))
        late = {missing for missing in self._missing if missing < oldest}
        self._missing -= late
        return max(0, oldest - newest - 1) + len(late)
