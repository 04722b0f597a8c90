"""Histograms of how long things took, from which the latencies of `metrics` are made."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

QUICK_S = (0.0001, 0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Upper ends of the buckets for work from a tenth of a millisecond (a snapshot) to seconds (drawing a picture)."""

LONG_S = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""The same for the worker's jobs, from the depth of an image to a commissioning."""


@dataclass(frozen=True, slots=True)
class HistogramCounts:
    """Durations under one set of labels. `counts` has one entry for each bucket and one more for what took longer than
    the last bound; the counts are not cumulative."""

    counts: tuple[int, ...]
    sum_s: float


class Histogram:
    """Durations by label, from any thread."""

    def __init__(self, bounds_s: Sequence[float]) -> None:
        """`bounds_s`: upper ends of the buckets, ascending, s; a duration equal to an end falls into its bucket."""
        self.bounds_s = tuple(bounds_s)
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, ...], list[int]] = {}
        self._sums_s: dict[tuple[str, ...], float] = {}

    def add(self, seconds: float, *labels: str) -> None:
        """Counts one duration. Labels come from fixed sets, never from a sender."""
        bucket = bisect_left(self.bounds_s, seconds)
        with self._lock:
            counts = self._counts.setdefault(labels, [0] * (len(self.bounds_s) + 1))
            counts[bucket] += 1
            self._sums_s[labels] = self._sums_s.get(labels, 0.0) + seconds

    def counted(self) -> dict[tuple[str, ...], HistogramCounts]:
        """The durations so far, by labels."""
        with self._lock:
            return {
                labels: HistogramCounts(tuple(counts), self._sums_s[labels]) for labels, counts in self._counts.items()
            }
