"""Puts the reports of several pairs into one order, whatever the order in which they arrive.

Every report has a sensor time from which it counts (`decisions.queue`). A pair that has come to some sensor time has
made all its reports that count up to there. Reports up to the time that all pairs have passed are taken, in the order
of these times; for equal times, in the order of the pairs' names. So a replay of a drive gives the same order at any
rate.

The order does not wait for a pair whose streams have stopped.
"""

from __future__ import annotations

import heapq
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from coec.runtime.ingest.sensor_clock import NS_PER_S

T = TypeVar("T")

SILENT_NS = 3 * NS_PER_S
"""Sensor time by which a pair that waits for no answer may be behind the foremost pair before its streams count as
stopped. Cameras of a rig come within a tenth of a second of each other, and over a network within one second."""

MOST_WAITING = 4096
"""How many reports may wait to be taken. Pairs wait for each other long before: a pair makes at most three reports a
second, so 32 pairs need 40 s for so many."""

NEVER_NS = -(2**62)
"""Before any sensor time."""


@dataclass(frozen=True, slots=True, order=True)
class Report(Generic[T]):
    """A report of a pair, and the sensor time from which it counts."""

    due_ns: int
    pair: str
    number: int
    what: T = field(compare=False)


@dataclass(slots=True)
class _PairProgress:
    """Where a pair is: all its reports that count up to `at_ns` are made, and its frames have come up to `head_ns`."""

    at_ns: int
    head_ns: int


class ReportSchedule(Generic[T]):
    """The order of the reports of one vehicle. Not safe for use from several threads at once: its owner has a lock.

    Attributes:
        taken_ns: all reports that count up to here were taken.
        losses: number of reports that came out of order or were lost, by cause.
    """

    def __init__(self) -> None:
        self.taken_ns = NEVER_NS
        self.losses: Counter[str] = Counter()
        self._places: dict[str, _PairProgress] = {}
        self._waiting: list[Report[T]] = []
        self._number = 0
        self._taking = False

    def report_time(self, pair: str, stamp_ns: int, *, waits: bool) -> None:
        """A pair has frames of this sensor time. If it `waits`, answers that count up to there are still missing; else
        it has made all its reports up to there."""
        place = self._places.get(pair)
        if place is None:
            place = self._places[pair] = _PairProgress(stamp_ns - 1 if waits else stamp_ns, stamp_ns)
        place.head_ns = max(place.head_ns, stamp_ns)
        if not waits:
            place.at_ns = max(place.at_ns, stamp_ns)
        self._advance()

    def put(self, pair: str, due_ns: int | None, what: T) -> None:
        """Takes in a report of a pair that counts from a sensor time on (None: from now on)."""
        if due_ns is None:
            due_ns = self.taken_ns
        elif due_ns <= self.taken_ns:
            self.losses["late"] += 1
        if len(self._waiting) >= MOST_WAITING:
            self.losses["overrun"] += 1
            return
        self._number += 1
        heapq.heappush(self._waiting, Report(due_ns, pair, self._number, what))
        self._advance()

    def take(self, *, all_are_silent: bool) -> Report[T] | None:
        """Takes out the next report; `took` has to follow. None while an earlier report may still come. Once the
        streams of all pairs have stopped, nothing is waited for."""
        if not self._waiting or not (all_are_silent or self._waiting[0].due_ns <= self._passed_ns()):
            return None
        self._taking = True
        return heapq.heappop(self._waiting)

    def finish(self, report: Report[T]) -> None:
        """Everything that follows from a report that was taken is known now."""
        self._taking = False
        self.taken_ns = max(self.taken_ns, report.due_ns if not self._waiting else self.taken_ns)
        self._advance()

    @property
    def is_ready(self) -> bool:
        """Whether a report can be taken."""
        return bool(self._waiting) and self._waiting[0].due_ns <= self._passed_ns()

    def step_back(self, stamp_ns: int, what: T) -> None:
        """Sensor time has stepped back to this stamp. Waiting reports still count; then comes `what`, and after it the
        new time."""
        self.losses["time_stepped_back"] += 1
        waiting = [replace(report, due_ns=stamp_ns, pair="") for report in sorted(self._waiting)]
        self._number += len(waiting) + 1
        first = self._number - len(waiting)
        self._waiting = [replace(report, number=first + place) for place, report in enumerate(waiting)]
        self._waiting.append(Report(stamp_ns, "", self._number, what))
        self.taken_ns = stamp_ns - 1
        for place in self._places.values():
            place.at_ns = place.head_ns = stamp_ns
        self._advance()

    def _passed_ns(self) -> int:
        """Sensor time up to which all pairs whose streams have not stopped have made their reports."""
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
