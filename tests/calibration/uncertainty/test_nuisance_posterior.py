"""What a window has against what it was told counts by how likely it is, and nothing about that jumps."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.calibration.uncertainty.nuisance_parameters import CENTRE_EVEN, centre_weight, posterior_weight

KNOWN_M = 0.01
"""What a rule leaves."""


def spread_of_reported(measured_m: float, off_m: float, rng: np.random.Generator) -> tuple[float, float]:
    """Of centres that are known to `KNOWN_M` and measured to `measured_m`, those that a window sees `off_m` beside: how
    far they are off in truth, along the way that they were seen; and what the window is believed of it."""
    truth = rng.normal(0.0, KNOWN_M, (400_000, 3))
    seen = truth + rng.normal(0.0, measured_m, truth.shape)
    size = np.linalg.norm(seen, axis=1)
    like = np.abs(size - off_m) < 0.05 * off_m
    along = np.sum(truth[like] * seen[like], axis=1) / size[like]
    return float(np.mean(along)), centre_weight(off_m / (2.0 * measured_m), off_m, KNOWN_M) * off_m


@pytest.mark.parametrize(("measured_m", "off_m"), [(0.003, 0.006), (0.01, 0.02), (0.02, 0.04), (0.03, 0.06)])
def test_a_centre_that_was_reported_right_counts_by_what_is_off_in_truth(
    measured_m: float, off_m: float, rng: np.random.Generator
) -> None:
    """However far beside a window that cannot tell it puts it. That it may have been told wrong adds a little."""
    off, believed = spread_of_reported(measured_m, off_m, rng)
    assert 0.9 * off < believed < off + 0.1 * off_m


@pytest.mark.fault(
    "a camera's centre is 30 cm from where it is held, and the window determines it to 3 cm", "the window is believed"
)
def test_a_centre_that_is_off_beyond_doubt_is_believed(record_property: Callable[[str, object], None]) -> None:
    believed = centre_weight(5.0, 0.30, KNOWN_M)
    record_property("figure", f"σ counts {100.0 * believed:.0f} % of what that turns the camera by")
    assert believed > 0.95
    assert centre_weight(inf, 0.30, 0.0) == pytest.approx(1.0)


def test_what_a_window_cannot_decide_of_a_centre_is_not_believed() -> None:
    """5 cm beside, two standard deviations, as chance has it in a room."""
    assert centre_weight(1.0, 0.05, KNOWN_M) < 0.3
    assert (
        centre_weight(0.0, 0.05, KNOWN_M)
        == centre_weight(-1.0, 0.05, KNOWN_M)
        == centre_weight(1.0, 0.0, KNOWN_M)
        == 0.0
    )


def test_where_nobody_knew_the_centre_what_is_measured_counts() -> None:
    assert centre_weight(CENTRE_EVEN, 0.05, 0.5) > 0.95
    assert centre_weight(CENTRE_EVEN, 0.05, 0.0) ** 2 == pytest.approx(0.5)


@given(certainty=st.floats(-4.0, 6.0), off_m=st.floats(0.001, 0.5), known_m=st.sampled_from([0.0, 0.003, KNOWN_M, 0.1]))
def test_no_posterior_jumps(certainty: float, off_m: float, known_m: float) -> None:
    """A hundredth of a standard deviation more or less, or of the shift, is a fiftieth of what counts, and a
    millimetre."""
    one = centre_weight(certainty, off_m, known_m)
    assert 0.0 <= one <= 1.0
    for other, other_m in [
        (centre_weight(certainty + 0.005, off_m, known_m), off_m),
        (centre_weight(certainty, 1.01 * off_m, known_m), 1.01 * off_m),
    ]:
        assert abs(other * other_m - one * off_m) < 0.02 * off_m + 0.001
    assert abs(posterior_weight(certainty + 0.005, 1.0) - posterior_weight(certainty, 1.0)) < 0.02


def test_what_is_right_or_not_is_believed_by_its_odds() -> None:
    assert posterior_weight(1.0, 1.0) ** 2 == pytest.approx(0.5)
    assert posterior_weight(2.0, 1.0) > 0.999
    assert posterior_weight(inf, 1.0) == 1.0
    assert posterior_weight(-inf, 1.0) == 0.0
    assert posterior_weight(0.5, 1.0) < 0.25
    assert posterior_weight(-0.5, 1.0) < posterior_weight(0.0, 1.0)
