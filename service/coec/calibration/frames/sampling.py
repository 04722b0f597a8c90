"""Choosing the pairs of a check of the monitor while the stream passes: evenly over each period of sensor time.

Periods are counted from the zero of sensor time, not from the first pair: a service that was restarted, and a replay at
any rate, cut the same checks. Unlike the pairs of a window these are not asked whether they are good: a dirty lens and
a frozen camera are what the monitor has to see.
"""

from __future__ import annotations

from coec.calibration.types import FramePair
from coec.config import MonitorConfig, WindowConfig

NS_PER_S = 1_000_000_000


class CheckSampler:
    """Keeps the pairs of the next check, at most `MonitorConfig.pairs`."""

    def __init__(self, config: MonitorConfig, window: WindowConfig) -> None:
        """`window` says when a vehicle stands: then nothing new can be seen."""
        self._config = config
        self._window = window
        self._period_ns = round(config.period_s * NS_PER_S)
        self._pairs: list[FramePair] = []
        self._period = self._cell = -1
        self._last_ns = -1

    def offer(self, pair: FramePair) -> tuple[FramePair, ...] | None:
        """Takes the next pair; the pairs of a check when the period before it was full enough, newest last."""
        stamp_ns = pair.stamp_ns
        if stamp_ns < self._last_ns:  # sensor time stepped back
            self._pairs.clear()
        self._last_ns = stamp_ns
        period, cell = stamp_ns // self._period_ns, stamp_ns * self._config.pairs // self._period_ns
        check = None
        if period != self._period and len(self._pairs) >= self._config.min_pairs:
            check = tuple(self._pairs)
            self._pairs.clear()
        self._period = period
        stands = pair.motion is not None and pair.motion.speed_mps < self._window.min_speed_mps
        if cell != self._cell and not (self._window.require_motion and stands):
            self._cell = cell
            self._pairs.append(pair)
            del self._pairs[: -self._config.pairs]
        return check

    def clear(self) -> None:
        """Forget what was kept: the extrinsic has changed, and a check must not mix two."""
        self._pairs.clear()
