"""Plays a recording at the pace at which it was made."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

NS_PER_S = 1_000_000_000


class Stamped(Protocol):
    """An item with a time stamp."""

    @property
    def stamp_ns(self) -> int:
        """Nanoseconds, by the clock of the recording."""
        ...


T = TypeVar("T", bound=Stamped)


@dataclass(slots=True)
class Played:
    """What has been published: frames (or messages) by stream, bytes, and the delays behind the due times, seconds: the
    largest (`late_s`) and that of the latest item."""

    frames: Counter[str]
    bytes: int = 0
    late_s: float = 0.0
    latest_late_s: float = 0.0


def paced(
    items: Iterable[T],
    rate: float,
    stop: threading.Event,
    send: Callable[[T], tuple[str, int]],
    on_sent: Callable[[T, Played], None],
    played: Played,
) -> Played:
    """Sends every item when it is due, `rate` times as fast as it was recorded; 0 = without waiting.

    Due times count from the first item, so that delays do not add up.

    Args:
        items: in ascending order of their stamps.
        rate: multiple of the recorded speed.
        stop: ends the playing before the next item.
        send: publishes an item and returns its stream and number of bytes.
        heard: called after each item.
        played: counters to go on with; also returned.
    """
    start_s = time.monotonic()
    first_ns: int | None = None
    for item in items:
        if stop.is_set():
            break
        if first_ns is None:
            first_ns, start_s = item.stamp_ns, time.monotonic()
        due_s = start_s + (item.stamp_ns - first_ns) / NS_PER_S / rate if rate > 0 else 0.0
        if rate > 0 and stop.wait(max(due_s - time.monotonic(), 0.0)):
            break
        stream, size = send(item)
        played.frames[stream] += 1
        played.bytes += size
        if rate > 0:
            played.latest_late_s = max(time.monotonic() - due_s, 0.0)
            played.late_s = max(played.late_s, played.latest_late_s)
        on_sent(item, played)
    return played


def repeated(
    passes: Callable[[], Iterable[T]], later: Callable[[T, int], T], shift_ns: int, pause_ns: int, forever: bool
) -> Iterator[T]:
    """The items of `passes()`, each moved by `shift_ns` with `later`. If `forever`, this repeats: each pass begins
    `pause_ns` after the last item of the pass before, so that time never steps back."""
    while True:
        first_ns, last_ns = None, 0
        for item in passes():
            first_ns = item.stamp_ns if first_ns is None else first_ns
            last_ns = item.stamp_ns
            yield later(item, shift_ns)
        if not forever or first_ns is None:
            return
        shift_ns += last_ns - first_ns + pause_ns
