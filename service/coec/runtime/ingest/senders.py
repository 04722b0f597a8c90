"""Who sends on one stream, as far as messages say so, and what the numbers of each tell about loss."""

from __future__ import annotations

from collections import OrderedDict, deque

from coec.runtime.ingest.sequence_numbers import SequenceNumbers

REMEMBERED = 8
"""Senders whose numbers are followed: the one that sends, and some that may have sent before it."""

RECENT = 64
"""Messages over which it shows whether senders take turns: two seconds of a camera."""


class Senders:
    """Of one stream; one thread uses it. Whoever does not say who it is has the empty id.

    A sender that ends and comes back has another id, so that one change of senders is no surprise; where it changes
    again within `RECENT` messages, two send at a time.
    """

    def __init__(self) -> None:
        self._numbers: OrderedDict[bytes, SequenceNumbers] = OrderedDict()
        self._recent: deque[tuple[bytes, bool]] = deque(maxlen=RECENT)
        self._changes = 0

    def counted(self, sender: bytes) -> None:
        """A message of theirs had come, was lost here, and was counted then."""
        self._of(sender).counted()

    def lost_by(self, sender: bytes, number: int) -> int:
        """How many messages of theirs are known to be lost on their way now that the one of this number has come."""
        changed = bool(self._recent) and self._recent[-1][0] != sender
        if len(self._recent) == RECENT:
            self._changes -= self._recent[0][1]
        self._recent.append((sender, changed))
        self._changes += changed
        return self._of(sender).lost_by(number)

    @property
    def taking_turns(self) -> tuple[bytes, ...]:
        """Ids of those that send at a time; none where it is one."""
        return tuple(sorted({sender for sender, _ in self._recent})) if self._changes > 1 else ()

    def _of(self, sender: bytes) -> SequenceNumbers:
        numbers = self._numbers.setdefault(sender, SequenceNumbers())
        self._numbers.move_to_end(sender)
        if len(self._numbers) > REMEMBERED:
            self._numbers.popitem(last=False)
        return numbers
