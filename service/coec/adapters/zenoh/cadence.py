"""A recording on the air at the cadence at which it was made."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

NS_PER_S = 1_000_000_000


class Stamped(Protocol):
    """Something that has its time."""

    @property
    def stamp_ns(self) -> int:
        """Nanoseconds, by the clock of the recording."""
        ...


T = TypeVar("T", bound=Stamped)


@dataclass(slots=True)
class Played:
    """What has been published: frames (or messages) by stream, bytes, and how far the latest was behind its time,
    seconds."""

    frames: Counter[str]
    bytes: int = 0
    late_s: float = 0.0
    latest_late_s: float = 0.0


def paced(
    items: Iterable[T],
    rate: float,
    stop: threading.Event,
    send: Callable[[T], tuple[str, int]],
    heard: Callable[[T, Played], None],
    played: Played,
) -> Played:
    """Sends every item when it is due, `rate` times as fast as it was recorded; 0 = without waiting.

    Times are counted from the first item, so that delays do not add up.

    Args:
        items: ascending by their stamps.
        rate: times recorded speed.
        stop: ends it before the next item.
        send: publishes; gives the stream and the bytes.
        heard: is told after each.
        played: is counted on.
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
        heard(item, played)
    return played


def repeated(
    passes: Callable[[], Iterable[T]], later: Callable[[T, int], T], shift_ns: int, pause_ns: int, forever: bool
) -> Iterator[T]:
    """The items of `passes()`, each `later` by `shift_ns`; if `forever`, again and again, each time `pause_ns` after
    the last item of the pass before: time never steps back."""
    while True:
        first_ns, last_ns = None, 0
        for item in passes():
            first_ns = item.stamp_ns if first_ns is None else first_ns
            last_ns = item.stamp_ns
            yield later(item, shift_ns)
        if not forever or first_ns is None:
            return
        shift_ns += last_ns - first_ns + pause_ns
