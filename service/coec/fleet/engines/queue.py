"""The queue of windows that wait for a process. It remembers which windows ended a process."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator

from coec.fleet.places import Job
from coec.fleet.trouble import lost
from coec.schemas.fleet import WindowRow

AHEAD = 2
"""How many windows a process has at a time: one that it solves, and one that it fetches meanwhile."""


class Queue:
    """The waiting windows. A window whose process ended is tried once more, alone in a process. The first end may have
    been caused by another window, or by memory that others had taken; the second one is caused by this window."""

    def __init__(self, jobs: Iterable[Job]) -> None:
        self._waiting = deque(jobs)
        self._suspected: set[Job] = set()

    def __bool__(self) -> bool:
        """Whether windows wait."""
        return bool(self._waiting)

    def next_for(self, has: Collection[Job]) -> Job | None:
        """The next window for a process that has these; None: it gets no more now."""
        if not self._waiting or len(has) >= AHEAD:
            return None
        if has and (self._waiting[0] in self._suspected or not self._suspected.isdisjoint(has)):
            return None
        return self._waiting.popleft()

    def give_back(self, has: Collection[Job], code: str, text: str) -> Iterator[WindowRow]:
        """A process with these windows has ended, for a reason. Queues the windows again, and returns the rows of those
        that are not tried again."""
        for job in reversed(list(has)):
            if job in self._suspected:
                yield lost(job, code, text)
            else:
                self._suspected.add(job)
                self._waiting.appendleft(job)
