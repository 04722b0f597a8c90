"""The queue of windows that wait for a process. It remembers which windows ended a process, and which failed for a
cause that is not their own."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator

from coec.fleet.engines.engine import NODE_LOST
from coec.fleet.places import Job
from coec.fleet.trouble import lost_row
from coec.schemas.fleet import WindowRow

WINDOWS_PER_WORKER = 2
"""How many windows a process has at a time: one that it solves, and one that it fetches meanwhile."""

MAX_LOSSES = 3
"""How many machines may be lost while they have a window. A window that exhausts a machine could end every one."""

MAX_TRIES = 2
"""How often a window is tried that fails for a common cause: a store may have been away for a moment."""


class WindowQueue:
    """The waiting windows. A window whose process ended is tried once more, alone in a process. The first end may have
    been caused by another window, or by memory that others had taken; the second one is caused by this window."""

    def __init__(self, jobs: Iterable[Job]) -> None:
        self._waiting = deque(jobs)
        self._suspected: set[Job] = set()
        self._losses: Counter[Job] = Counter()
        self._tries: Counter[Job] = Counter()
        self._unjudged = 0

    def __bool__(self) -> bool:
        """Whether windows wait."""
        return bool(self._waiting)

    @property
    def unjudged(self) -> int:
        """How many windows failed for a common cause as often as they are tried."""
        return self._unjudged

    def next_for(self, assigned: Collection[Job]) -> Job | None:
        """The next window for a process that has these; None: it gets no more now."""
        if not self._waiting or len(assigned) >= WINDOWS_PER_WORKER:
            return None
        if assigned and (self._waiting[0] in self._suspected or not self._suspected.isdisjoint(assigned)):
            return None
        return self._waiting.popleft()

    def retry_alone(self, assigned: Collection[Job], code: str, text: str) -> Iterator[WindowRow]:
        """A process with these windows has ended, for a reason. Queues the windows again, and returns the rows of those
        that are not tried again."""
        for job in reversed(list(assigned)):
            if job in self._suspected:
                yield lost_row(job, code, text)
            else:
                self._suspected.add(job)
                self._waiting.appendleft(job)

    def requeue(self, assigned: Collection[Job]) -> None:
        """Queues windows again, before all others, that a process had but has not finished through no fault of theirs.
        Nothing is remembered about them."""
        self._waiting.extendleft(reversed(list(assigned)))

    def requeue_lost(self, assigned: Collection[Job], text: str) -> Iterator[WindowRow]:
        """The machine with these windows was lost, which is hardly their fault. Queues them again before all others,
        and returns the rows of those that have been lost too often."""
        for job in reversed(list(assigned)):
            self._losses[job] += 1
            if self._losses[job] >= MAX_LOSSES:
                yield lost_row(job, NODE_LOST, f"{text}, as were {MAX_LOSSES - 1} machines that had it before")
            else:
                self._waiting.appendleft(job)

    def postpone(self, job: Job) -> None:
        """A window failed for a common cause. It is tried again after all others, `MAX_TRIES` times in all."""
        self._tries[job] += 1
        if self._tries[job] < MAX_TRIES:
            self._waiting.append(job)
        else:
            self._unjudged += 1
