"""The processor time that the worker has spent, by purpose and time."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

USAGE_OVER_S = 180.0
"""Time over which `cores` is averaged, s: a window and the checks beside it, at the default length of a slice."""

USAGE_BIN_S = 5.0
"""Width of the bins in which the time is counted, s."""


class CpuUsage:
    """Processor time spent. Times are of one steady clock, s."""

    def __init__(self, begin_s: float) -> None:
        self._begin_s = begin_s
        self._bins: deque[tuple[int, float]] = deque()
        self._totals: dict[tuple[str, str], float] = {}

    def add(self, kind: str, pair: str, cpu_s: float, now_s: float) -> None:
        """Adds processor time of work of this kind, for a pair or (empty) for none."""
        self._totals[kind, pair] = self._totals.get((kind, pair), 0.0) + cpu_s
        index = int(now_s // USAGE_BIN_S)
        if self._bins and self._bins[-1][0] == index:
            cpu_s += self._bins.pop()[1]
        self._bins.append((index, cpu_s))
        while self._bins[0][0] * USAGE_BIN_S < now_s - USAGE_OVER_S:
            self._bins.popleft()

    def cores(self, now_s: float) -> float:
        """Cores in use on average over the last `OVER_S`, or since the beginning."""
        spent_s = sum(cpu_s for index, cpu_s in self._bins if index * USAGE_BIN_S >= now_s - USAGE_OVER_S)
        return spent_s / max(min(now_s - self._begin_s, USAGE_OVER_S), USAGE_BIN_S)

    @property
    def totals_s(self) -> Mapping[tuple[str, str], float]:
        """Processor time since the beginning by kind and pair, s."""
        return dict(self._totals)
