"""The senders of one stream, as far as messages name them, and how many messages of each were lost."""

from __future__ import annotations

from collections import OrderedDict, deque

from coec.runtime.ingest.sequence_numbers import SequenceNumbers

REMEMBERED = 8
"""How many senders' numbers are followed: that of the present sender and of some earlier ones."""

RECENT = 64
"""Recent messages that show whether senders take turns: two seconds of a camera."""


class Senders:
    """The senders of one stream; one thread uses it. A sender that does not name itself has the empty id.

    A sender that restarts has a new id, so one change of senders is normal. If the sender changes again within `RECENT`
    messages, two are sending at the same time.
    """

    def __init__(self) -> None:
        self._numbers: OrderedDict[bytes, SequenceNumbers] = OrderedDict()
        self._recent: deque[tuple[bytes, bool]] = deque(maxlen=RECENT)
        self._changes = 0

    def counted(self, sender: bytes) -> None:
        """A message of this sender came, was lost in this process, and has been counted already."""
        self._of(sender).counted()

    def lost_by(self, sender: bytes, number: int) -> int:
        """How many messages of this sender are now known to be lost on their way, given that this number has come."""
        changed = bool(self._recent) and self._recent[-1][0] != sender
        if len(self._recent) == RECENT:
            self._changes -= self._recent[0][1]
        self._recent.append((sender, changed))
        self._changes += changed
        return self._of(sender).lost_by(number)

    @property
    def taking_turns(self) -> tuple[bytes, ...]:
        """Ids of the senders that send at the same time; empty if there is only one."""
        return tuple(sorted({sender for sender, _ in self._recent})) if self._changes > 1 else ()

    def _of(self, sender: bytes) -> SequenceNumbers:
        numbers = self._numbers.setdefault(sender, SequenceNumbers())
        self._numbers.move_to_end(sender)
        if len(self._numbers) > REMEMBERED:
            self._numbers.popitem(last=False)
        return numbers
