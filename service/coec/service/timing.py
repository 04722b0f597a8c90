"""Time: the sensor time while no sample comes, one clock of driving for all pairs, histograms of how long things took,
from which the latencies of `metrics` are made, and token buckets, which limit rates. Sensor time is extrapolated
because a slice must end even when the streams have stopped. The clock of driving shows the stamps of the pair that is
farthest ahead; the processor budget is earned by it. A replay at ten times the pace of the drive therefore earns and
spends ten times as much per second, and makes the same checks as the drive did, on any machine that keeps up.
"""

import threading
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from coec.calibration.types import NS_PER_S


class Clock:
    """The clocks of this machine. A replay gives others."""

    def monotonic_s(self) -> float:
        """A steady clock, s."""
        return time.monotonic()

    def wall_ns(self) -> int:
        """The clock on the wall, ns since 1970."""
        return time.time_ns()


OBSERVATIONS = 32
"""Number of pairs from which the ratio of sensor time to wall time is taken: three seconds at 10 Hz."""

MIN_SILENCE_S = 5.0
"""Wall time without a pair before sensor time is extrapolated, s: longer than a busy machine keeps a sender waiting."""

SILENT_GAPS = 3.0
"""The silence must also last this many times the longest recent pause, because a slow replay is not silent."""

MAX_RATIO = 1000.0


class TokenBucket:
    """A level that time fills at a constant rate, up to a depth. It begins full. What is taken may leave a debt: the
    level is then below zero until time has paid it back.

    Attributes:
        depth: largest level.
        level: tokens in the bucket when it was last filled.
    """

    def __init__(self, depth: float, now_s: float = 0.0) -> None:
        self.depth = self.level = depth
        self._now_s = now_s

    def fill(self, now_s: float, rate: float) -> float:
        """Time has come to `now_s`: adds `rate` tokens for each second since the last call, and returns the level."""
        return self.add(self.advance(now_s) * rate)

    def advance(self, now_s: float) -> float:
        """Seconds since the last call; 0 if the clock went back."""
        passed_s, self._now_s = max(now_s - self._now_s, 0.0), max(now_s, self._now_s)
        return passed_s

    def add(self, tokens: float) -> float:
        """Adds tokens, up to the depth, and returns the level."""
        self.level = min(self.level + tokens, self.depth)
        return self.level


class SensorClock:
    """Extrapolates sensor time from the monotonic clock at the observed ratio of the two.

    In a replay at rate r, r seconds of sensor time pass per second, so its slices end at the same sensor time as those
    of the drive. The estimate is used only to end slices in silence: while pairs come, their own stamps decide.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[int, float]] = deque(maxlen=OBSERVATIONS)

    def observe(self, stamp_ns: int, monotonic_s: float) -> None:
        """A pair with this stamp was formed now. A stamp that steps back starts anew."""
        if self._seen and stamp_ns <= self._seen[-1][0]:
            self._seen.clear()
        self._seen.append((stamp_ns, monotonic_s))

    @property
    def rate_hz(self) -> float | None:
        """Recent pairs per second of sensor time; None before the second pair."""
        if len(self._seen) < 2:
            return None
        return (len(self._seen) - 1) * NS_PER_S / (self._seen[-1][0] - self._seen[0][0])

    @property
    def pace(self) -> float | None:
        """Seconds of sensor time per second of the steady clock, over the recent pairs; None before the second pair."""
        return self._ratio() if len(self._seen) >= 2 else None

    def is_silent(self, monotonic_s: float) -> bool:
        """Whether no pair has come for much longer than the recent pauses."""
        if not self._seen:
            return True
        times_s = [seen_s for _, seen_s in self._seen]
        longest_s = max((b - a for a, b in pairwise(times_s)), default=0.0)
        return monotonic_s - times_s[-1] >= max(MIN_SILENCE_S, SILENT_GAPS * longest_s)

    def silent_now_ns(self, monotonic_s: float) -> int | None:
        """Extrapolated sensor time if the streams are silent; else None, because then stamps tell the time."""
        if not self._seen or not self.is_silent(monotonic_s):
            return None
        stamp_ns, seen_s = self._seen[-1]
        return stamp_ns + round(self._ratio() * (monotonic_s - seen_s) * NS_PER_S)

    def _ratio(self) -> float:
        (first_ns, first_s), (last_ns, last_s) = self._seen[0], self._seen[-1]
        if last_s <= first_s:
            return 1.0
        return min((last_ns - first_ns) / NS_PER_S / (last_s - first_s), MAX_RATIO)


class DriveClock:
    """Seconds of driving since the first stamp. The stamps of different pairs need not be of the same clock."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._last_ns: dict[str, int] = {}
        self._reached_s: dict[str, float] = {}

    def observe(self, pair: str, stamp_ns: int, gap_s: float) -> float:
        """The stream of a pair has come to a stamp. Returns the time now, s. A step back, or ahead by more than
        `gap_s`, does not count as driving: the pair goes on from where the others are. So does a pair that has fallen
        behind by more than `gap_s`."""
        last_ns = self._last_ns.get(pair)
        self._last_ns[pair] = stamp_ns
        passed_s = 0.0 if last_ns is None else (stamp_ns - last_ns) / NS_PER_S
        reached_s = self._reached_s.get(pair, self.now_s)
        if not 0.0 <= passed_s <= gap_s or self.now_s - reached_s > gap_s:
            reached_s, passed_s = self.now_s, 0.0
        self._reached_s[pair] = reached_s + passed_s
        self.now_s = max(self.now_s, reached_s + passed_s)
        return self.now_s


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
