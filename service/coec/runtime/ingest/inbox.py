"""Where samples wait between the network's thread and the ingest thread of a pair: bounded, oldest out first."""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Parcel:
    """One sample as it came. `order` counts arrivals over all streams of the inbox; `encoding` is the sender's."""

    order: int
    stream: str
    payload: bytes
    encoding: str


@dataclass(frozen=True, slots=True)
class Call:
    """Work that another thread wants done on the ingest thread, between two samples."""

    run: Callable[[], None]


@dataclass(frozen=True, slots=True)
class Arrivals:
    """What came on a stream: samples that wait, and how long ago the last one came; None before the first."""

    waiting: int
    age_s: float | None


class Inbox:
    """The streams of one pair. `put` takes microseconds and never blocks on the reader; one thread takes."""

    def __init__(self, depths: dict[str, int], on_overrun: Callable[[str], None]) -> None:
        """`depths` maps each stream to the number of samples that may wait; `on_overrun(stream)` is called for each
        that had to go."""
        self._queues: dict[str, deque[Parcel]] = {stream: deque(maxlen=depth) for stream, depth in depths.items()}
        self._came_s: dict[str, float] = {}
        self._calls: deque[Call] = deque()
        self._on_overrun = on_overrun
        self._order = itertools.count()
        self._condition = threading.Condition()

    def put(self, stream: str, payload: bytes, encoding: str) -> None:
        """A sample came."""
        with self._condition:
            queue = self._queues[stream]
            overrun = len(queue) == queue.maxlen
            self._came_s[stream] = time.monotonic()
            queue.append(Parcel(next(self._order), stream, payload, encoding))
            self._condition.notify()
        if overrun:
            self._on_overrun(stream)

    def call(self, run: Callable[[], None]) -> None:
        """Have `run` called by the reader, before the samples that wait."""
        with self._condition:
            self._calls.append(Call(run))
            self._condition.notify()

    def arrivals(self, monotonic_s: float) -> dict[str, Arrivals]:
        """By stream, at this time of the steady clock."""
        with self._condition:
            return {
                stream: Arrivals(len(queue), None if came_s is None else max(monotonic_s - came_s, 0.0))
                for stream, queue in self._queues.items()
                for came_s in (self._came_s.get(stream),)
            }

    def wake(self) -> None:
        """Let a waiting `take` return."""
        with self._condition:
            self._condition.notify()

    def take(self, timeout_s: float) -> Parcel | Call | None:
        """The next call, else the sample that came first; None when nothing came within `timeout_s` or on `wake`."""
        with self._condition:
            taken = self._pop()
            if taken is None:
                self._condition.wait(timeout_s)
                taken = self._pop()
            return taken

    def _pop(self) -> Parcel | Call | None:
        if self._calls:
            return self._calls.popleft()
        waiting = [queue for queue in self._queues.values() if queue]
        return min(waiting, key=lambda queue: queue[0].order).popleft() if waiting else None
