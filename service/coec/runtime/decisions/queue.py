"""The questions about a pair, in the order in which they were asked. An answer counts only after all those before it.

How long an answer takes depends on the machine, but what it changes must not. So every question gets, when it is asked,
a sensor time from which its answer counts in the choice of further pairs. The stream waits for the answer before it
looks at a pair of that time. A replay of a drive is therefore judged in the same way, at any rate and on any machine.
Answers are served the moment they come; only the stream waits.

Every question ends: with its answer, or when it has waited longer than an answer may take, so that a lost question does
not hold up those behind it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

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
