"""What a piece of work costs: measured as it is done, smoothed, bounded."""

from __future__ import annotations

from collections import deque

KEPT = 9
"""Measurements of which the middle one is the price: what else the machine does, a process that is new and a hard scene
move none of the middle ones as long as they are fewer than half."""

MOST_S = 600.0
"""Of processor time that one measurement may say: five times the longest that a job may take by default."""


class Price:
    """Processor time of one kind of work, s.

    Attributes:
        cpu_s: the middle one of the last measurements, of two the lower; 0 before the first.
    """

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=KEPT)
        self.cpu_s = 0.0

    def add(self, cpu_s: float) -> None:
        """It took so much."""
        self._seen.append(min(max(cpu_s, 0.0), MOST_S))
        self.cpu_s = middle_s(list(self._seen))

    @property
    def known(self) -> bool:
        """Whether it was measured at all."""
        return bool(self._seen)


def middle_s(measured_s: list[float]) -> float:
    """The middle one, of two the lower; 0 where there is none."""
    return sorted(measured_s)[(len(measured_s) - 1) // 2] if measured_s else 0.0
