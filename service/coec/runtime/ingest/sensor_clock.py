"""Estimates the sensor time while no sample comes, because a slice must end even when the streams have stopped."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

NS_PER_S = 1_000_000_000

OBSERVATIONS = 32
"""Number of pairs from which the ratio of sensor time to wall time is taken: three seconds at 10 Hz."""

MIN_SILENCE_S = 5.0
"""Wall time without a pair before sensor time is extrapolated, s: longer than a busy machine keeps a sender waiting."""

SILENT_GAPS = 3.0
"""The silence must also last this many times the longest recent pause, because a slow replay is not silent."""

MAX_RATIO = 1000.0


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
