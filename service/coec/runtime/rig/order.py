"""One order for what several pairs say, whatever the order in which it is known.

What a pair says has a sensor time: that from which it counts (`decisions.queue`). A pair that is at some sensor time
has said everything that counts up to there. What all pairs have passed is taken in the order of these times, and of the
names of the pairs where they are the same. So a drive that is replayed, at any rate, is put together in the same way.

A pair whose streams have stopped is not waited for.
"""

from __future__ import annotations

import heapq
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from coec.runtime.ingest.sensor_clock import NS_PER_S

T = TypeVar("T")

SILENT_NS = 3 * NS_PER_S
"""Sensor time by which a pair that has nothing to wait for may be behind the foremost: cameras of a rig come within a
tenth of a second of each other, and networks within one."""

MOST_WAITING = 4096
"""Of what was said and is not taken. Pairs wait for each other long before: a pair says three things in a second at
most, of which 32 pairs say so many in 40 s."""

NEVER_NS = -(2**62)
"""Before any sensor time."""


@dataclass(frozen=True, slots=True, order=True)
class Said(Generic[T]):
    """Something that a pair said, and the sensor time from which it counts."""

    due_ns: int
    pair: str
    number: int
    what: T = field(compare=False)


@dataclass(slots=True)
class _Place:
    """Where a pair is: all that counts up to `at_ns` is said, and pairs of frames have come up to `head_ns`."""

    at_ns: int
    head_ns: int


class Order(Generic[T]):
    """Of one vehicle. Not safe for use from several threads at once: its owner has a lock.

    Attributes:
        taken_ns: all that counts up to here was taken.
        losses: what came out of order, by cause.
    """

    def __init__(self) -> None:
        self.taken_ns = NEVER_NS
        self.losses: Counter[str] = Counter()
        self._places: dict[str, _Place] = {}
        self._waiting: list[Said[T]] = []
        self._number = 0
        self._taking = False

    def at(self, pair: str, stamp_ns: int, *, waits: bool) -> None:
        """A pair has frames of this sensor time; it `waits` to look at them for answers that count up to there, or has
        said all of them."""
        place = self._places.get(pair)
        if place is None:
            place = self._places[pair] = _Place(stamp_ns - 1 if waits else stamp_ns, stamp_ns)
        place.head_ns = max(place.head_ns, stamp_ns)
        if not waits:
            place.at_ns = max(place.at_ns, stamp_ns)
        self._advance()

    def put(self, pair: str, due_ns: int | None, what: T) -> None:
        """A pair says something that counts from a sensor time on; None: from now on."""
        if due_ns is None:
            due_ns = self.taken_ns
        elif due_ns <= self.taken_ns:
            self.losses["late"] += 1
        if len(self._waiting) >= MOST_WAITING:
            self.losses["overrun"] += 1
            return
        self._number += 1
        heapq.heappush(self._waiting, Said(due_ns, pair, self._number, what))
        self._advance()

    def take(self, *, all_are_silent: bool) -> Said[T] | None:
        """What is to be taken next, and to be followed by `took`; None while that is not certain. Once the streams of
        all pairs have stopped, nothing is waited for."""
        if not self._waiting or not (all_are_silent or self._waiting[0].due_ns <= self._passed_ns()):
            return None
        self._taking = True
        return heapq.heappop(self._waiting)

    def took(self, said: Said[T]) -> None:
        """All that follows from it is known."""
        self._taking = False
        self.taken_ns = max(self.taken_ns, said.due_ns if not self._waiting else self.taken_ns)
        self._advance()

    @property
    def is_ready(self) -> bool:
        """Whether there is something that is to be taken."""
        return bool(self._waiting) and self._waiting[0].due_ns <= self._passed_ns()

    def step_back(self, stamp_ns: int, what: T) -> None:
        """Sensor time has stepped back, to this stamp. What waits counts still, then comes `what`, and with it the new
        time."""
        self.losses["time_stepped_back"] += 1
        waiting = [replace(said, due_ns=stamp_ns, pair="") for said in sorted(self._waiting)]
        self._number += len(waiting) + 1
        first = self._number - len(waiting)
        self._waiting = [replace(said, number=first + place) for place, said in enumerate(waiting)]
        self._waiting.append(Said(stamp_ns, "", self._number, what))
        self.taken_ns = stamp_ns - 1
        for place in self._places.values():
            place.at_ns = place.head_ns = stamp_ns
        self._advance()

    def _passed_ns(self) -> int:
        """Where all pairs are whose streams have not stopped."""
        foremost_ns = max((place.head_ns for place in self._places.values()), default=NEVER_NS)
        return min(
            (
                place.at_ns
                for place in self._places.values()
                if place.at_ns < place.head_ns or foremost_ns - place.at_ns <= SILENT_NS
            ),
            default=NEVER_NS,
        )

    def _advance(self) -> None:
        if self._taking:
            return
        passed_ns = self._passed_ns()
        self.taken_ns = max(self.taken_ns, min(passed_ns, self._waiting[0].due_ns - 1) if self._waiting else passed_ns)
