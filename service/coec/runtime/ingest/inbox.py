"""The queue of samples between the network's threads and the ingest thread, bounded in number for each stream and in
bytes for all streams together."""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from coec.adapters.zenoh.inputs import InputSample


@dataclass(frozen=True, slots=True)
class Parcel:
    """One sample as it came. `order` counts arrivals over all streams of the inbox."""

    order: int
    stream: str
    sample: InputSample


@dataclass(frozen=True, slots=True)
class Call:
    """Work that another thread wants done on the ingest thread, between two samples."""

    run: Callable[[], None]


@dataclass(frozen=True, slots=True)
class Arrivals:
    """What came on a stream: how many samples wait, and how long ago the last one came (None before the first)."""

    waiting: int
    age_s: float | None


class _Waiting:
    """The samples of one stream, oldest first."""

    def __init__(self, depth: int) -> None:
        self.parcels: deque[Parcel] = deque()
        self.depth = depth
        self.bytes = 0

    def add(self, parcel: Parcel) -> None:
        self.parcels.append(parcel)
        self.bytes += len(parcel.sample.payload)

    def take(self) -> Parcel:
        parcel = self.parcels.popleft()
        self.bytes -= len(parcel.sample.payload)
        return parcel


class Inbox:
    """The streams of one reader. `put` takes microseconds and never blocks on the reader; one thread takes.

    Surplus samples are dropped. A stream with too many samples loses its oldest. If all streams together hold too many
    bytes, the stream that holds most loses its oldest, so that large messages on one stream push nothing out of
    another.
    """

    def __init__(self, depths: dict[str, int], max_bytes: int, on_overrun: Callable[[Parcel], None]) -> None:
        """
        Args:
            depths: by stream, how many samples may wait.
            max_bytes: limit for all waiting samples together. The latest sample is taken whatever its size.
            on_overrun: called with each sample that is dropped.
        """
        self._waiting = {stream: _Waiting(depth) for stream, depth in depths.items()}
        self._max_bytes = max_bytes
        self._received_s: dict[str, float] = {}
        self._calls: deque[Call] = deque()
        self._on_overrun = on_overrun
        self._order = itertools.count()
        self._condition = threading.Condition()

    def put(self, stream: str, sample: InputSample) -> None:
        """A sample came."""
        with self._condition:
            gone = self._make_room(stream, len(sample.payload))
            self._waiting[stream].add(Parcel(next(self._order), stream, sample))
            self._received_s[stream] = time.monotonic()
            self._condition.notify()
        for overrun in gone:
            self._on_overrun(overrun)

    def receiver(self, stream: str) -> Callable[[InputSample], None]:
        """`put` for one stream."""
        return partial(self.put, stream)

    def open(self, stream: str, depth: int) -> None:
        """Adds a stream, of which `depth` samples may wait."""
        with self._condition:
            self._waiting = {**self._waiting, stream: _Waiting(depth)}

    def call(self, run: Callable[[], None]) -> None:
        """Has the reader call `run`, before it takes the waiting samples."""
        with self._condition:
            self._calls.append(Call(run))
            self._condition.notify()

    def arrivals(self, monotonic_s: float) -> dict[str, Arrivals]:
        """What came, by stream; ages are counted at this time of the steady clock."""
        with self._condition:
            return {
                stream: Arrivals(
                    len(waiting.parcels), None if received_s is None else max(monotonic_s - received_s, 0.0)
                )
                for stream, waiting in self._waiting.items()
                for received_s in (self._received_s.get(stream),)
            }

    def waiting(self) -> set[str]:
        """The streams that have waiting samples."""
        with self._condition:
            return {stream for stream, waiting in self._waiting.items() if waiting.parcels}

    def wake(self) -> None:
        """Let a waiting `take` return."""
        with self._condition:
            self._condition.notify()

    def take(self, timeout_s: float) -> Parcel | Call | None:
        """The next call, else the oldest sample; None if nothing came within `timeout_s`, or after `wake`."""
        with self._condition:
            taken = self._pop()
            if taken is None:
                self._condition.wait(timeout_s)
                taken = self._pop()
            return taken

    def _make_room(self, stream: str, size: int) -> list[Parcel]:
        """Takes out the samples that have to make room for a new one of `size` bytes."""
        gone = []
        own = self._waiting[stream]
        if len(own.parcels) == own.depth:
            gone.append(own.take())
        while sum(waiting.bytes for waiting in self._waiting.values()) + size > self._max_bytes:
            # The new sample counts for its stream, so that a stream with large samples makes room for them itself.
            held = {name: waiting.bytes + size * (name == stream) for name, waiting in self._waiting.items()}
            full = [name for name, waiting in self._waiting.items() if waiting.parcels]
            if not full:
                break
            fullest = max(full, key=lambda name: held[name])
            gone.append(self._waiting[fullest].take())
        return gone

    def _pop(self) -> Parcel | Call | None:
        if self._calls:
            return self._calls.popleft()
        waiting = [waiting for waiting in self._waiting.values() if waiting.parcels]
        return min(waiting, key=lambda one: one.parcels[0].order).take() if waiting else None
