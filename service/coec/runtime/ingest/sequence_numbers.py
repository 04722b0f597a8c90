"""What the numbers of the frames of a stream tell about loss.

A number that is left out is lost once it has become late: a frame that was only overtaken comes within a few others. It
is then no loss of the network's, and what becomes of it is counted where that is decided: once.
"""

from __future__ import annotations

MAX_GAP = 100_000
"""A larger step is a sender that started to count anew: at 100 Hz this would be a quarter of an hour of loss."""

LATE_FRAMES = 16
"""Frames that may overtake another: 1.6 s at 10 Hz, the depth of the inbox."""


class SequenceNumbers:
    """Of one stream; one thread uses it."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._awaited: set[int] = set()
        self._counted = 0
        self._since_counted = 0

    def counted(self) -> None:
        """A frame that had come was lost here, and was counted then: its number is left out, too. Whoever sent it may
        not have numbered it, so that no gap of much later is taken for its."""
        self._counted += 1
        self._since_counted = 0

    def lost_by(self, number: int) -> int:
        """How many frames are known to be lost on their way now that the one of this number has come."""
        lost = self._left_out_by(number)
        known = min(lost, self._counted)
        self._since_counted += 1
        self._counted = 0 if self._since_counted > 2 * LATE_FRAMES else self._counted - known
        return lost - known

    def _left_out_by(self, number: int) -> int:
        newest = self._newest
        if newest is not None and newest - LATE_FRAMES <= number <= newest:  # late, or for the second time
            self._awaited.discard(number)
            return 0
        self._newest = number
        if newest is None or not newest < number <= newest + MAX_GAP:
            # A new count: what the old one left out does not come any more.
            lost = len(self._awaited)
            self._awaited.clear()
            return lost
        oldest = number - LATE_FRAMES
        self._awaited.update(range(max(newest + 1, oldest), number))
        late = {awaited for awaited in self._awaited if awaited < oldest}
        self._awaited -= late
        return max(0, oldest - newest - 1) + len(late)
