"""Chooses the pairs of a check of the monitor while the stream passes, evenly over each period of sensor time.

Periods are counted from the zero of sensor time, not from the first pair, so that a restarted service and a replay at
any rate cut the same checks. Unlike the pairs of a window these are not selected for quality, because the monitor has
to see a dirty lens, a frozen camera, and a mount that is hit while the vehicle stands.
"""

from __future__ import annotations

from collections.abc import Sequence

from coec.calibration.types import FramePair
from coec.config import MonitorConfig, WindowConfig

NS_PER_S_SAMPLING = 1_000_000_000

SPAN_PERIODS = 6
"""Periods that the pairs of one check may span. The slowest useful stream, with a pair per period, fills the four pairs
of a check in four periods; two more allow for losses. Pairs further apart do not belong to one check. From then on its
checks share pairs, so that one is completed in every period."""


MOVING_MPS = 1.0
"""Above this speed a vehicle passes the things that it sees."""


def drives(pairs: Sequence[FramePair]) -> bool:
    """Whether the vehicle is known to be on the move in most of the pairs."""
    return 2 * sum(pair.motion is not None and pair.motion.reaches(MOVING_MPS) for pair in pairs) > len(pairs)


def stands(pair: FramePair, window: WindowConfig) -> bool:
    """Whether the vehicle is known to stand, so that it sees nothing new."""
    return pair.motion is not None and pair.motion.stays_below(window.min_speed_mps)


class CheckSampler:
    """Keeps the pairs of the next check, at most `MonitorConfig.pairs`."""

    def __init__(self, config: MonitorConfig) -> None:
        self._config = config
        self._period_ns = round(config.period_s * NS_PER_S_SAMPLING)
        self._pairs: list[FramePair] = []
        self._new = 0
        self._period = self._cell = -1
        self._last_ns = -1

    def offer(self, pair: FramePair) -> tuple[FramePair, ...] | None:
        """Takes the next pair. Returns the pairs of a check, newest last, if a period has ended with enough of them."""
        stamp_ns = pair.stamp_ns
        if stamp_ns < self._last_ns:  # sensor time stepped back
            self._pairs.clear()
            self._new = 0
        self._last_ns = stamp_ns
        oldest_ns = stamp_ns - SPAN_PERIODS * self._period_ns
        self._pairs = [earlier for earlier in self._pairs if earlier.stamp_ns >= oldest_ns]
        period, cell = stamp_ns // self._period_ns, stamp_ns * self._config.pairs // self._period_ns
        check = None
        if period != self._period and self._new > 0 and len(self._pairs) >= self._config.min_pairs:
            check = tuple(self._pairs)
            if check[-1].stamp_ns - check[0].stamp_ns < self._period_ns:
                self._pairs.clear()
            self._new = 0
        self._period = period
        if cell != self._cell:
            self._cell = cell
            self._pairs.append(pair)
            self._new += 1
            del self._pairs[: -self._config.pairs]
        return check
