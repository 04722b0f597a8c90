"""The inbox of the engine: samples of the sensors, bounded in number for each stream and in bytes for all together, and
events of other threads.
"""

import itertools
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from functools import partial
from typing import Any

from coec.errors import CoecError
from coec.io.zenoh.bus import InputSample


@dataclass(frozen=True, slots=True)
class Parcel:
    """One sample as it came. `order` counts arrivals over all streams of the inbox."""

    order: int
    stream: str
    sample: InputSample


class BusyError(CoecError):
    """The service did not begin the work in time, so nothing was done; or the work has begun and has not ended."""

    reply_code = "busy"


STARTED = "The work was started and has not finished; see `history` for its result."
"""Text of a `BusyError` for work that goes on."""


class PendingReply:
    """What a thread waits for that has posted an event."""

    def __init__(self) -> None:
        self._future: Future[Any] = Future()

    def begin(self) -> bool:
        """Whether somebody still waits; from now on the reply has begun."""
        return self._future.set_running_or_notify_cancel()

    def finish(self, reply: object) -> None:
        """Gives the reply."""
        self._future.set_result(reply)

    def fail(self, error: Exception) -> None:
        """Has an exception raised where the reply is awaited."""
        self._future.set_exception(error)

    def result(self, timeout_s: float) -> Any:
        """Waits up to `timeout_s` for the reply. If it has begun by then, waits once more as long.

        Raises:
            BusyError: the reply was not begun within `timeout_s` and will not be; or it was begun and has not ended.
        """
        try:
            return self._future.result(timeout_s)
        except TimeoutError:
            if self._future.cancel():
                raise BusyError("The service is busy; nothing was done. Retry.") from None
        except CancelledError:
            raise BusyError("The service is stopping; nothing was done.") from None
        try:
            return self._future.result(timeout_s)
        except TimeoutError:
            raise BusyError(STARTED) from None


COMMANDS_WAITING = 16
"""How many commands of people may wait for one pair; every further one is answered `busy`. Outcomes of jobs need no
bound here, because the worker's queue bounds the jobs."""


@dataclass(frozen=True, slots=True)
class Posted:
    """An event for a receiver, from another thread. If there is a `reply`, that thread waits for it."""

    receiver: str
    event: Any
    reply: PendingReply | None = None


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
    """The streams of one reader, and the events that other threads post. `put` takes microseconds and never blocks on
    the reader; one thread takes.

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
        self._posted: deque[Posted] = deque()
        self._commands: Counter[str] = Counter()
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

    def post(self, receiver: str, event: object) -> None:
        """Has the reader hand an event to a receiver, before it takes the waiting samples."""
        with self._condition:
            self._posted.append(Posted(receiver, event))
            self._condition.notify()

    def request(self, receiver: str, event: object, timeout_s: float) -> Any:
        """Posts an event and waits for its reply; an exception of the reader is raised here.

        Raises:
            BusyError: too many such events wait, or this one was not begun within `timeout_s`, and nothing was done; or
                it has not ended.
        """
        reply = PendingReply()
        with self._condition:
            if self._commands[receiver] >= COMMANDS_WAITING:
                raise BusyError("Too many commands are queued; nothing was done. Retry.")
            self._commands[receiver] += 1
            self._posted.append(Posted(receiver, event, reply))
            self._condition.notify()
        try:
            return reply.result(timeout_s)
        finally:
            with self._condition:
                self._commands[receiver] -= 1

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

    def take(self, timeout_s: float) -> Parcel | Posted | None:
        """The next posted event, else the oldest sample; None if nothing came within `timeout_s`, or after `wake`."""
        with self._condition:
            taken = self._pop()
            if taken is None and timeout_s > 0.0:
                self._condition.wait(timeout_s)
                taken = self._pop()
            return taken

    def take_posted(self) -> Posted | None:
        """The next posted event; None if there is none."""
        with self._condition:
            return self._posted.popleft() if self._posted else None

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

    def _pop(self) -> Parcel | Posted | None:
        if self._posted:
            return self._posted.popleft()
        waiting = [waiting for waiting in self._waiting.values() if waiting.parcels]
        return min(waiting, key=lambda one: one.parcels[0].order).take() if waiting else None
