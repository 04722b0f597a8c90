"""How long things took, counted into buckets as they end: what the latencies of `metrics` are made of."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

QUICK_S = (0.0001, 0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Upper ends of the buckets of what takes from a tenth of a millisecond (a snapshot) to seconds (a picture drawn)."""

LONG_S = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Of what the worker does: from the depth of an image to a commissioning."""


@dataclass(frozen=True, slots=True)
class Counted:
    """What was seen under one label. `counts` has one entry for each bound and one more for what took longer; none is
    part of another."""

    counts: tuple[int, ...]
    sum_s: float


class Histogram:
    """Durations by label, from any thread."""

    def __init__(self, bounds_s: Sequence[float]) -> None:
        """`bounds_s`: upper ends of the buckets, ascending, s; each belongs to its bucket."""
        self.bounds_s = tuple(bounds_s)
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, ...], list[int]] = {}
        self._sums_s: dict[tuple[str, ...], float] = {}

    def add(self, seconds: float, *labels: str) -> None:
        """Something took so long. Labels come from fixed sets, never from a sender."""
        bucket = bisect_left(self.bounds_s, seconds)
        with self._lock:
            counts = self._counts.setdefault(labels, [0] * (len(self.bounds_s) + 1))
            counts[bucket] += 1
            self._sums_s[labels] = self._sums_s.get(labels, 0.0) + seconds

    def counted(self) -> dict[tuple[str, ...], Counted]:
        """What was seen so far, by labels."""
        with self._lock:
            return {labels: Counted(tuple(counts), self._sums_s[labels]) for labels, counts in self._counts.items()}
