"""The price of a piece of work, from measurements of work that was done: smoothed and bounded."""

from __future__ import annotations

from collections import deque

COST_SAMPLES = 9
"""How many measurements are kept; their median is the price. Outliers (other load on the machine, a new process, a hard
scene) do not move it while they are fewer than half."""

LARGEST_COST_S = 600.0
"""Most processor time that one measurement counts, s: five times the longest that a job may take by default."""


class CostModel:
    """Processor time of one kind of work, s.

    Attributes:
        cpu_s: median of the last measurements, the lower one of two; 0 before the first.
    """

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=COST_SAMPLES)
        self.cpu_s = 0.0

    def add(self, cpu_s: float) -> None:
        """Adds a measurement."""
        self._seen.append(min(max(cpu_s, 0.0), LARGEST_COST_S))
        self.cpu_s = lower_median_s(list(self._seen))

    @property
    def known(self) -> bool:
        """Whether there is any measurement."""
        return bool(self._seen)


def lower_median_s(measured_s: list[float]) -> float:
    """The median, the lower one of two; 0 if there are no measurements."""
    return sorted(measured_s)[(len(measured_s) - 1) // 2] if measured_s else 0.0
