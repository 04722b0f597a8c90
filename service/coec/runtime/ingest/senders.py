"""The senders of one stream: who sends, whether several send at the same time, and how many messages of each were lost.

ROS publishers name themselves beside each message. Other senders are told apart by the session or router that stamped
their messages, as far as it did, and by their numbers, or without numbers by their stamps: numbers and stamps of one
sender go on, while those of two senders alternate between two sequences.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field

from coec.runtime.ingest.sequence_numbers import LATE_FRAMES, MAX_GAP, SequenceNumbers

REMEMBERED = 8
"""How many senders' numbers are followed: that of the present sender and of some earlier ones."""

RECENT = 64
"""Recent messages that show whether senders take turns: two seconds of a camera."""

TRIAL = 3
"""So many messages in a row, and a new sender has replaced the one before; until then that may come back."""

STEP_NS = 2 * 10**9
"""Stamps without numbers that differ by less belong to one sequence, ns."""


@dataclass(slots=True, eq=False)
class _Track:
    """The sequence of messages of one sender that does not name itself.

    Attributes:
        id: stands for the sender.
        origin: who stamped its messages for Zenoh.
        numbers: its numbers; while it is on trial after another track of this origin (`before`), they wait.
        recent: sensor stamp by number, of the latest messages.
    """

    id: bytes
    origin: bytes
    before: _Track | None = None
    numbers: SequenceNumbers = field(default_factory=SequenceNumbers)
    waiting: list[int] = field(default_factory=list)
    recent: OrderedDict[int, int] = field(default_factory=OrderedDict)
    newest: int | None = None
    stamp_ns: int = 0

    def fits(self, number: int | None, stamp_ns: int) -> bool:
        """Whether a message with this number and stamp can be the next of this sender, or a late one."""
        if number is None or self.newest is None:
            return self.newest is number is None and abs(stamp_ns - self.stamp_ns) <= STEP_NS
        if not self.newest - LATE_FRAMES <= number <= self.newest + LATE_FRAMES:
            return False
        # One sender's stamps are in the order of its numbers. Equal stamps say nothing: some senders have none.
        return all(
            stamp_ns == other_ns if number == other else (stamp_ns - other_ns) * (number - other) >= 0
            for other, other_ns in self.recent.items()
        )

    def goes_on(self, number: int | None, stamp_ns: int) -> bool:
        """Whether a message can be of this track, which is on trial, after a gap: where most messages are lost, each of
        those that come follows a gap."""
        if self.before is None or number is None or self.newest is None:
            return False
        return self.newest < number <= self.newest + MAX_GAP and stamp_ns >= self.stamp_ns

    def add(self, number: int | None, stamp_ns: int) -> None:
        """The message is of this sender."""
        self.stamp_ns = stamp_ns
        if number is None:
            return
        self.newest = number if self.newest is None else max(self.newest, number)
        self.recent[number] = stamp_ns
        if len(self.recent) > 2 * LATE_FRAMES:
            self.recent.popitem(last=False)

    def end_trial(self, *, replaces: bool) -> int:
        """Counts the numbers that waited. `replaces`: nobody else has sent meanwhile, so that this is the sender before
        after a gap or a restart; it takes over the id and the numbers. Returns how many messages are known to be
        lost."""
        if replaces and self.before is not None:
            self.id, self.before.id = self.before.id, self.id
            self.numbers, self.before.numbers = self.before.numbers, SequenceNumbers()
        waiting, self.waiting, self.before = self.waiting, [], None
        return sum(self.numbers.lost_by(number) for number in waiting)


class Senders:
    """The senders of one stream; one thread uses it. `lost_by` and `unnamed` come for each message, `took` for each
    whose frame fits the stream.

    A named sender that restarts has a new id, so one change of senders is normal. If the sender changes again within
    `RECENT` messages, two are sending at the same time.
    """

    def __init__(self) -> None:
        self._numbers: OrderedDict[bytes, SequenceNumbers] = OrderedDict()
        self._tracks: deque[_Track] = deque(maxlen=REMEMBERED)
        self._made = 0
        self._recent: deque[tuple[bytes, bool]] = deque(maxlen=RECENT)
        self._changes = 0
        self._in_a_row = TRIAL

    def counted(self, sender: bytes) -> None:
        """A message of this sender came, was lost in this process, and has been counted already. Without an id, it is
        one of the latest unnamed sender."""
        if sender:
            self._of(sender).counted()
        elif self._tracks:
            self._tracks[0].numbers.counted()

    def lost_by(self, sender: bytes, number: int) -> int:
        """How many messages of a named sender are now known to be lost on their way, given that this number has
        come."""
        return self._of(sender).lost_by(number)

    def unnamed(self, origin: bytes, number: int | None, stamp_ns: int) -> tuple[bytes, int]:
        """Which sender a message without an id is of, and how many messages are now known to be lost on their way.

        Args:
            origin: who stamped the message for Zenoh; empty if nobody did.
            number: None: its sender gives no numbers.
            stamp_ns: its sensor stamp.
        """
        latest = self._tracks[0] if self._tracks else None
        track = next((one for one in self._tracks if one.origin == origin and one.fits(number, stamp_ns)), None)
        if track is None and latest is not None and latest.origin == origin:
            pause = number is latest.newest is None and stamp_ns > latest.stamp_ns
            track = latest if pause or latest.goes_on(number, stamp_ns) else None
        lost = 0
        if latest is not None and track is not latest and latest.before is not None:
            lost += latest.end_trial(replaces=False)
        if track is None:
            self._made += 1
            before = latest if latest is not None and latest.origin == origin and number is not None else None
            track = _Track(origin + b"#" + str(self._made).encode(), origin, before)
        if track in self._tracks:
            self._tracks.remove(track)
        self._tracks.appendleft(track)
        track.add(number, stamp_ns)
        if number is None:
            return track.id, lost
        if track.before is None:
            return track.id, lost + track.numbers.lost_by(number)
        track.waiting.append(number)
        if len(track.waiting) >= TRIAL:
            new = track.id
            lost += track.end_trial(replaces=True)
            self._rename(new, track.id)
        return track.id, lost

    def took(self, sender: bytes) -> None:
        """A frame of this sender, which may be one of `unnamed`, fits the stream."""
        before = self._recent[-1][0] if self._recent else sender
        changed = before != sender
        if len(self._recent) == RECENT:
            self._changes -= self._recent[0][1]
        self._recent.append((sender, changed))
        self._changes += changed
        self._in_a_row = 1 if changed else min(self._in_a_row + 1, TRIAL)

    def _rename(self, sender: bytes, known: bytes) -> None:
        """Messages of the new `sender` turn out to be of one that is known already."""
        renamed = [known if one == sender else one for one, _ in self._recent]
        self._recent.clear()
        self._changes = 0
        for index, one in enumerate(renamed):
            changed = index > 0 and renamed[index - 1] != one
            self._recent.append((one, changed))
            self._changes += changed

    @property
    def on_trial(self) -> bool:
        """Whether the present sender is new, so that the one before may come back."""
        return self._in_a_row < TRIAL

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
