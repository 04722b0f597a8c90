"""What counts from a sensor time on: the results that one stream has requested, in the order of the requests, and the
reports of several streams, put into one order whatever the order in which they arrive.

How long a result takes depends on the machine, but what it changes must not. So every request gets, when it is
submitted, a sensor time from which its result counts in the selection of further frames. The stream waits for the
result before it evaluates frames of that time. A replay of a drive is therefore evaluated in the same way, at any rate
and on any machine. Results are served the moment they come; only the stream waits.

Every request ends: with its result, or when it has waited longer than a result may take, so that a lost one does not
hold up those behind it.

Every report of a pair to the rig has such a time, too. A pair that has come to some sensor time has made all its
reports that count up to there. Reports up to the time that all pairs have passed are taken, in the order of these
times; for equal times, in the order of the pairs' names. The order does not wait for a pair whose streams have stopped.

Both belong to the thread of the engine.
"""

import heapq
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from coec.calibration.types import NS_PER_S

Subject = TypeVar("Subject")
Result = TypeVar("Result")
Change = TypeVar("Change")


@dataclass(slots=True, eq=False)
class Request(Generic[Subject, Result, Change]):
    """One request.

    Attributes:
        subject: what was requested.
        due_ns: sensor time from which frames are evaluated only once the result is known.
        expires_s: time after which the result is no longer awaited, by the clock of the caller.
        result: the result; None until it has come.
        change: what the result changes in the selection of frames, once it was concluded.
    """

    subject: Subject
    due_ns: int
    expires_s: float
    result: Result | None = None
    change: Change | None = None


class Schedule(Generic[Subject, Result, Change]):
    """The requests of one stream: submit, answer, conclude in the order of submission, apply when due."""

    def __init__(self) -> None:
        self._concluded: deque[Request[Subject, Result, Change]] = deque()
        self._open: deque[Request[Subject, Result, Change]] = deque()

    def submit(self, subject: Subject, due_ns: int, expires_s: float) -> Request[Subject, Result, Change]:
        """Adds a request. It is due no earlier than those before it, because its result waits for theirs."""
        last = self._open[-1] if self._open else self._concluded[-1] if self._concluded else None
        request = Request[Subject, Result, Change](
            subject, due_ns if last is None else max(due_ns, last.due_ns), expires_s
        )
        self._open.append(request)
        return request

    def unanswered_about(self, subject: Subject) -> Request[Subject, Result, Change] | None:
        """The request about a subject that has no result yet; None if there is none."""
        return next((one for one in self._open if one.result is None and one.subject == subject), None)

    def answer(self, request: Request[Subject, Result, Change], result: Result) -> bool:
        """The result of a request has come. Returns whether it counts: a second result, or one of a request that was
        withdrawn, does not."""
        if request.result is not None or request not in self._open:
            return False
        request.result = result
        return True

    def next_answered(self) -> Request[Subject, Result, Change] | None:
        """The request whose result is to be concluded next: the oldest one that is open, if its result has come."""
        return self._open[0] if self._open and self._open[0].result is not None else None

    def conclude(self, request: Request[Subject, Result, Change], change: Change | None) -> None:
        """What the result of `next_answered` changes is known."""
        self._open.popleft()
        request.change = change
        self._concluded.append(request)

    def expired(self, now_s: float) -> list[Request[Subject, Result, Change]]:
        """Requests without a result that have waited too long; each is to be answered with a failure."""
        return [one for one in self._open if one.result is None and one.expires_s <= now_s]

    @property
    def oldest(self) -> Request[Subject, Result, Change] | None:
        """The oldest request that is not concluded; None if there is none."""
        return self._open[0] if self._open else None

    @property
    def unanswered(self) -> int:
        """Number of requests that are not concluded."""
        return len(self._open)

    def waits(self, stamp_ns: int) -> bool:
        """Whether a result has yet to come before frames of this sensor time are evaluated."""
        return bool(self._open) and self._open[0].due_ns <= stamp_ns

    def take_due(self, stamp_ns: int) -> list[Change]:
        """Frames of this sensor time are about to be evaluated: removes and returns the changes that are due, in
        order."""
        due = []
        while self._concluded and self._concluded[0].due_ns <= stamp_ns:
            change = self._concluded.popleft().change
            if change is not None:
                due.append(change)
        return due

    def bring_forward(self, stamp_ns: int) -> None:
        """Sensor time has stepped back to this stamp: makes all outstanding results due with the first frames of the
        new time."""
        for request in (*self._concluded, *self._open):
            request.due_ns = min(request.due_ns, stamp_ns)

    def withdraw(self) -> int:
        """Drops all requests, because their stamps mean nothing any more. Returns how many there were."""
        dropped = len(self._concluded) + len(self._open)
        self._concluded.clear()
        self._open.clear()
        return dropped


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
    """The order of the reports of one vehicle.

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
        """Takes out the next report; `finish` has to follow. None while an earlier report may still come. Once the
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
