"""Equation (2) of Borer et al. 2023 with limits that were learned on a rig.

failed if MI < MI_lim or f' > f'_lim or f'' < f''_lim
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Protocol

import numpy as np

from coec.calibration.commissioning.quantiles import normal_quantile


class PaperFigures(Protocol):
    """The three figures at a pose."""

    @property
    def mi(self) -> float:
        """Equation (1), nats."""
        ...

    @property
    def f1(self) -> float:
        """Largest slope of the rotations, nats per radian."""
        ...

    @property
    def f2(self) -> float:
        """Least peakedness of the rotations, nats per radian²."""
        ...


@dataclass(frozen=True, slots=True)
class PaperLimits:
    """Limits of the three figures, in their units; the defaults refuse nothing."""

    min_mi: float = -inf
    max_f1: float = inf
    min_f2: float = -inf

    def flags(self, figures: PaperFigures) -> bool:
        """Whether equation (2) says failed."""
        return figures.mi < self.min_mi or figures.f1 > self.max_f1 or figures.f2 < self.min_f2

    @classmethod
    def learned(cls, right: Sequence[PaperFigures], false_alarm_rate: float) -> PaperLimits:
        """Limits that refuse this share of right poses, a third of it by each figure, if the figures of `right` (at
        least two) are samples of a normal distribution."""
        z = normal_quantile(1.0 - false_alarm_rate / 3.0)
        return cls(
            min_mi=beyond([figures.mi for figures in right], -z),
            max_f1=beyond([figures.f1 for figures in right], z),
            min_f2=beyond([figures.f2 for figures in right], -z),
        )


def beyond(values: Sequence[float], z: float) -> float:
    """The value that lies z standard deviations from the mean."""
    return float(np.mean(values) + z * np.std(values, ddof=1))
