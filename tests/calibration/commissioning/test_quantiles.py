"""Quantiles against tables."""

import pytest

from coec.calibration.baseline import chi2_quantile, distance2_quantile, normal_quantile


@pytest.mark.parametrize(("probability", "value"), [(0.5, 0.0), (0.975, 1.959964), (0.01, -2.326348)])
def test_normal(probability: float, value: float) -> None:
    assert normal_quantile(probability) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize(
    ("probability", "dof", "value"),
    [(0.99, 3, 11.3449), (0.995, 3, 12.8382), (0.95, 1, 3.8415)],
)
def test_chi_squared(probability: float, dof: int, value: float) -> None:
    assert chi2_quantile(probability, dof) == pytest.approx(value, rel=0.03)


@pytest.mark.parametrize("probability", [0.0, 1.0, -0.1, float("nan")])
def test_beyond_probabilities(probability: float) -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        normal_quantile(probability)


@pytest.mark.parametrize(
    ("probability", "dof", "known_by", "value"),
    # dof times the F distribution: 3 · 8.081, 3 · 6.476, 3.581² (tables); with all known it is χ².
    [(0.995, 3, 10, 24.24), (0.995, 3, 15, 19.43), (0.99, 1, 10, 3.169**2), (0.995, 3, 10**6, 12.84)],
)
def test_distance_from_an_estimated_spread(probability: float, dof: int, known_by: int, value: float) -> None:
    assert distance2_quantile(probability, dof, known_by) == pytest.approx(value, rel=0.03)


def test_a_spread_of_two_samples_has_no_rare_quantile() -> None:
    with pytest.raises(ValueError, match="2 degrees of freedom determine no quantile"):
        distance2_quantile(0.9999, 3, 2)
