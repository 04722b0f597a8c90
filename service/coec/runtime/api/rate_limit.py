"""How often a sender may give commands: a bucket of tokens for each, filled at a constant rate.

Who has proven his name has a bucket that nobody else draws from. All others are what the attachments of their queries
say, which anyone may write (a query tells nothing else of who asks): so the number of their buckets is bounded, and
those for whom there is none share one. Whoever invents a name for each command is in that one with all of his kind.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

BURST = 20
"""Commands at once: more than a person, or a script that works through all of them, gives in a row."""

PER_S = 1.0
"""Commands per second afterwards. Nothing that a command does makes sense more often: each is written down, with two
fsyncs, by the one thread that also takes the answers to checks."""

SENDERS = 64
"""Buckets of their own: some 10 kB."""


@dataclass(slots=True)
class _Bucket:
    tokens: float
    at_s: float


class RateLimit:
    """Of one pair. Safe to use from several threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` tells seconds."""
        self._clock = clock
        self._lock = threading.Lock()
        self._reserved: dict[str, _Bucket] = {}
        self._buckets: dict[str, _Bucket] = {}
        self._others = _Bucket(BURST, clock())

    def reserve_for(self, proven: Iterable[str]) -> None:
        """These senders, whom nobody can pass himself off as, and no others, have buckets of their own for good. Who
        had one keeps what is in it."""
        with self._lock:
            before, now_s = self._reserved, self._clock()
            self._reserved = {sender: before.get(sender, _Bucket(BURST, now_s)) for sender in proven}

    def take(self, sender: str) -> float:
        """0 when `sender` may give a command now, which is counted; else how many seconds he has to wait for that."""
        with self._lock:
            now_s = self._clock()
            bucket = self._bucket_of(sender, now_s)
            bucket.tokens = _filled(bucket, now_s)
            bucket.at_s = now_s
            if bucket.tokens < 1.0:
                return (1.0 - bucket.tokens) / PER_S
            bucket.tokens -= 1.0
            return 0.0

    def _bucket_of(self, sender: str, now_s: float) -> _Bucket:
        if sender in self._reserved:
            return self._reserved[sender]
        if sender not in self._buckets and len(self._buckets) >= SENDERS:
            # Who has given none for so long that his bucket is full again is not told from one who is new.
            self._buckets = {name: held for name, held in self._buckets.items() if _filled(held, now_s) < BURST}
        if sender not in self._buckets:
            if len(self._buckets) >= SENDERS:
                return self._others
            self._buckets[sender] = _Bucket(BURST, now_s)
        return self._buckets[sender]


def _filled(bucket: _Bucket, now_s: float) -> float:
    """Tokens by now."""
    return min(BURST, bucket.tokens + (now_s - bucket.at_s) * PER_S)
