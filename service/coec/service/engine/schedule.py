"""What counts from a sensor time on: the pending results of a pair, in the order in which they were requested, and the
reports of several pairs, put into one order whatever the order in which they arrive.

How long a result takes depends on the machine, but what it changes must not. So every request gets, when it is
submitted, a sensor time from which its result counts in the selection of further frames. The stream waits for the
result before it evaluates a pair of that time. A replay of a drive is therefore evaluated in the same way, at any rate
and on any machine. Results are served the moment they come; only the stream waits.

Every request ends: with its result, or when it has waited longer than a result may take, so that a lost one does not
hold up those behind it.

Every report of a pair to the rig has such a time, too. A pair that has come to some sensor time has made all its
reports that count up to there. Reports up to the time that all pairs have passed are taken, in the order of these
times; for equal times, in the order of the pairs' names. The order does not wait for a pair whose streams have stopped.
"""

import heapq
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from coec.service.timing import NS_PER_S

Effect = Callable[[], None]
"""Applies what an answer changes in the choice of further pairs; run by the thread that chooses them."""

TakeResult = Callable[[], Effect | None]
"""Takes an answer and returns its effect; run by the thread that decides."""


@dataclass(slots=True, eq=False)
class PendingRequest:
    """One question.

    Attributes:
        due_ns: sensor time from which pairs are looked at only once the answer is known.
        expires_s: time after which the answer is no longer awaited, by the steady clock less what does not count.
        name: id of the window that the question is about; empty for a check.
        take: takes the answer; None until it has come.
        effect: effect of the answer, once it was taken.
    """

    due_ns: int
    expires_s: float
    name: str = ""
    take: TakeResult | None = None
    effect: Effect | None = None
    taken: bool = False


class ResultSchedule:
    """The questions of one pair. One thread asks and lets answers take effect, one thread answers."""

    def __init__(self, paused_s: Callable[[], float] = lambda: 0.0) -> None:
        """`paused_s()`: time so far that does not count as waiting, s: that in which the worker compiled kernels."""
        self._paused_s = paused_s
        self._lock = threading.Lock()
        self._pending: deque[PendingRequest] = deque()
        self._untaken: deque[PendingRequest] = deque()

    def submit(self, due_ns: int, expires_s: float, name: str = "") -> PendingRequest:
        """Asks a question. It is due no earlier than those before it, because its answer has to wait for theirs."""
        with self._lock:
            before_ns = self._pending[-1].due_ns if self._pending else due_ns
            request = PendingRequest(max(due_ns, before_ns), expires_s - self._paused_s(), name)
            self._pending.append(request)
            self._untaken.append(request)
            return request

    def about(self, name: str) -> PendingRequest | None:
        """The unanswered question about a window; None if there is none."""
        with self._lock:
            return next((one for one in self._untaken if one.name == name and one.take is None), None)

    def answer(self, request: PendingRequest, take: TakeResult) -> None:
        """The answer to a question has come. It is taken as soon as all those in front are. A second answer to the same
        question is ignored."""
        if request.take is None:
            request.take = take
        self._take_answered()

    def expire(self, monotonic_s: float, lost: Callable[[PendingRequest], TakeResult]) -> int:
        """Gives up questions that have waited too long; `lost(question)` stands in for the answer. Returns how many
        there were."""
        counted_s = monotonic_s - self._paused_s()
        with self._lock:
            late = [one for one in self._untaken if one.take is None and one.expires_s <= counted_s]
        for request in late:
            request.take = lost(request)
        if late:
            self._take_answered()
        return len(late)

    @property
    def unanswered(self) -> int:
        """Number of questions whose answer has not come, or waits for one in front of it. For any thread."""
        return len(self._untaken)

    def waits(self, stamp_ns: int) -> bool:
        """Whether an answer has yet to come before a pair of this sensor time is looked at."""
        with self._lock:
            return bool(self._untaken) and self._untaken[0].due_ns <= stamp_ns

    def settle(self, stamp_ns: int) -> None:
        """A pair of this sensor time is about to be looked at: the answers that are due take effect."""
        with self._lock:
            due = []
            while self._pending and self._pending[0].taken and self._pending[0].due_ns <= stamp_ns:
                due.append(self._pending.popleft())
        for request in due:
            if request.effect is not None:
                request.effect()

    def bring_forward(self, stamp_ns: int) -> None:
        """Sensor time has stepped back to this stamp: makes all outstanding answers due with the first pair of the new
        time."""
        with self._lock:
            for request in self._pending:
                request.due_ns = min(request.due_ns, stamp_ns)

    def _take_answered(self) -> None:
        while True:
            with self._lock:
                first = self._untaken[0] if self._untaken else None
                if first is None or first.take is None:
                    return
            # Taken outside the lock, so that the stream may ask meanwhile. Only the thread that answers takes.
            first.effect = first.take()
            with self._lock:
                self._untaken.popleft()
                first.taken = True


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
