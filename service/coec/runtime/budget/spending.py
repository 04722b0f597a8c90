"""What the worker has taken of the processor, by what it was for and when."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

OVER_S = 180.0
"""Over which the cores are told: a window and the checks beside it, at the default length of a slice."""

BIN_S = 5.0
"""In which it is counted."""


class Spending:
    """Times are of one steady clock, s."""

    def __init__(self, begin_s: float) -> None:
        self._begin_s = begin_s
        self._bins: deque[tuple[int, float]] = deque()
        self._totals: dict[tuple[str, str], float] = {}

    def add(self, kind: str, pair: str, cpu_s: float, now_s: float) -> None:
        """So much processor time went into work of this kind for a pair; empty where it is for none."""
        self._totals[kind, pair] = self._totals.get((kind, pair), 0.0) + cpu_s
        index = int(now_s // BIN_S)
        if self._bins and self._bins[-1][0] == index:
            cpu_s += self._bins.pop()[1]
        self._bins.append((index, cpu_s))
        while self._bins[0][0] * BIN_S < now_s - OVER_S:
            self._bins.popleft()

    def cores(self, now_s: float) -> float:
        """Of a core, over the last `OVER_S`, or since the beginning."""
        spent_s = sum(cpu_s for index, cpu_s in self._bins if index * BIN_S >= now_s - OVER_S)
        return spent_s / max(min(now_s - self._begin_s, OVER_S), BIN_S)

    @property
    def totals_s(self) -> Mapping[tuple[str, str], float]:
        """Processor time since the beginning by kind and pair, s."""
        return dict(self._totals)
