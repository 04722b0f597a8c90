"""The paper's classifier with limits that were learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from coec.calibration.baseline import PaperLimits


@dataclass(frozen=True)
class Figures:
    mi: float
    f1: float
    f2: float


GOOD = Figures(1.0, 5.0, 100.0)
LIMITS = PaperLimits(min_mi=0.8, max_f1=8.0, min_f2=60.0)


def test_each_figure_is_refused_on_its_own_side_of_its_limit() -> None:
    assert not LIMITS.flags(GOOD)
    assert LIMITS.flags(Figures(0.7, 5.0, 100.0))
    assert LIMITS.flags(Figures(1.0, 9.0, 100.0))
    assert LIMITS.flags(Figures(1.0, 5.0, 50.0))


def test_limits_of_nothing_refuse_nothing() -> None:
    assert not PaperLimits().flags(Figures(-1e9, 1e9, -1e9))


@pytest.mark.parametrize("rate", [0.01, 0.1])
def test_learned_limits_flag_about_the_stated_share_of_right_poses(rate: float) -> None:
    rng = np.random.default_rng(5)
    samples = rng.normal([1.0, 5.0, 100.0], [0.1, 1.0, 10.0], (40_000, 3))
    right = [Figures(*row) for row in samples.tolist()]
    limits = PaperLimits.learned(right[:20_000], rate)
    flagged = np.mean([limits.flags(figures) for figures in right[20_000:]])
    assert flagged == pytest.approx(rate, rel=0.2)
