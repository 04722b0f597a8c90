"""How often a sender may give commands: each sender has a bucket of tokens that is filled at a constant rate.

A sender who has proven his name has a bucket that nobody else draws from. All other senders are known only by the
attachments of their queries, which anyone may write. So the number of their buckets is bounded, and those without one
share a common bucket. A sender who invents a new name for each command ends up in the common one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

BURST = 20
"""How many commands may come at once: more than a person gives in a row, or a script that uses every command."""

PER_S = 1.0
"""Commands per second after that. No command makes sense more often, and each one is written down, with two fsyncs, by
the same thread that takes the answers to checks."""

SENDERS = 64
"""How many senders have their own bucket: some 10 kB."""


@dataclass(slots=True)
class _CommandBucket:
    tokens: float
    at_s: float


class RateLimit:
    """The rate limit of one pair. Safe to use from several threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a clock in seconds."""
        self._clock = clock
        self._lock = threading.Lock()
        self._reserved: dict[str, _CommandBucket] = {}
        self._buckets: dict[str, _CommandBucket] = {}
        self._others = _CommandBucket(BURST, clock())

    def reserve_for(self, proven: Iterable[str]) -> None:
        """Gives these proven senders, and no others, buckets of their own for good. A sender who had one keeps its
        content."""
        with self._lock:
            before, now_s = self._reserved, self._clock()
            self._reserved = {sender: before.get(sender, _CommandBucket(BURST, now_s)) for sender in proven}

    def take(self, sender: str) -> float:
        """0 if `sender` may give a command now, which is then counted; else how many seconds he has to wait."""
        with self._lock:
            now_s = self._clock()
            bucket = self._bucket_of(sender, now_s)
            bucket.tokens = _filled(bucket, now_s)
            bucket.at_s = now_s
            if bucket.tokens < 1.0:
                return (1.0 - bucket.tokens) / PER_S
            bucket.tokens -= 1.0
            return 0.0

    def _bucket_of(self, sender: str, now_s: float) -> _CommandBucket:
        if sender in self._reserved:
            return self._reserved[sender]
        if sender not in self._buckets and len(self._buckets) >= SENDERS:
            # A sender whose bucket is full again is treated like a new one, so his bucket can go.
            self._buckets = {name: held for name, held in self._buckets.items() if _filled(held, now_s) < BURST}
        if sender not in self._buckets:
            if len(self._buckets) >= SENDERS:
                return self._others
            self._buckets[sender] = _CommandBucket(BURST, now_s)
        return self._buckets[sender]


def _filled(bucket: _CommandBucket, now_s: float) -> float:
    """Tokens in the bucket by now."""
    return min(BURST, bucket.tokens + (now_s - bucket.at_s) * PER_S)
