"""Normalised errors on claims whose figures are known by hand."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.geometry import se3
from coec_lab.experiments.solve_statistics import (
    BIN_EDGES,
    CONFIDENCES,
    Claims,
    SolveOutcome,
    Trial,
    carried,
    gathered,
    normalise,
    of_differences,
    of_outcomes,
    score,
    within,
)
from lab.experiments.test_statistics import FAR, REFERENCE, _estimate, _xi


def _claims(errors: list[list[float]], sigma: float | list[float]) -> Claims:
    covariance = np.diag(np.broadcast_to(np.asarray(sigma, np.float64) ** 2, 6))
    return Claims(np.array(errors), np.tile(covariance, (len(errors), 1, 1)), refused=0)


def _finished(*deg: float, sigma_deg: float = 0.1, accepted: bool = True) -> SolveOutcome:
    return score(Trial(FAR, _estimate(_xi(*deg), accepted, radians(sigma_deg)), 1.0), REFERENCE, 3)


def test_coverage_counts_errors_within_claims() -> None:
    result = normalise(_claims([[0.5] * 6, [-1.5] * 6, [2.5] * 6, [-4.0] * 6], 1.0), independent=4)
    np.testing.assert_array_equal(result.coverage, np.array([[0.25] * 6, [0.5] * 6, [0.75] * 6]))
    np.testing.assert_allclose(result.rms, np.sqrt((0.25 + 2.25 + 6.25 + 16.0) / 4.0))
    np.testing.assert_array_equal(result.largest, 4.0)
    np.testing.assert_allclose(result.sigma_over_rms, 1.0 / result.rms)
    assert result.nees == pytest.approx((0.25 + 2.25 + 6.25 + 16.0) / 4.0)


def test_histogram_keeps_the_sign_and_its_ends_are_open() -> None:
    result = normalise(_claims([[-9.0] * 6, [-0.2] * 6, [0.2] * 6, [9.0] * 6], 1.0), independent=4)
    middle = len(BIN_EDGES) // 2
    expected = np.zeros(len(BIN_EDGES) - 1, int)
    expected[[0, middle - 1, middle, -1]] = 1
    for counts in result.histogram:
        np.testing.assert_array_equal(counts, expected)


def test_true_claims_lie_on_the_diagonal_and_narrow_ones_below() -> None:
    rng = np.random.default_rng(7)
    errors = rng.normal(size=(4000, 6)).tolist()
    true, narrow = normalise(_claims(errors, 1.0), 4000), normalise(_claims(errors, 0.5), 4000)
    np.testing.assert_allclose(true.reliability, np.array(CONFIDENCES)[:, None] * np.ones(6), atol=0.03)
    np.testing.assert_allclose(true.coverage[:, 0], [0.683, 0.954, 0.997], atol=0.02)
    assert true.nees_bounds[0] < true.nees < true.nees_bounds[1]
    assert (narrow.reliability < true.reliability).all()
    assert narrow.nees > 3.5 > narrow.nees_bounds[1]


def test_correlated_errors_are_measured_along_their_ellipse() -> None:
    covariance = np.eye(6)
    covariance[0, 4] = covariance[4, 0] = 0.9
    along, across = np.zeros(6), np.zeros(6)
    along[[0, 4]], across[0], across[4] = 1.0, 1.0, -1.0
    claims = gathered([(along, covariance)]), gathered([(across, covariance)])
    result = [normalise(claim, 1).nees * 6.0 for claim in claims]
    assert result == pytest.approx([2.0 / 1.9, 2.0 / 0.1])


def test_bounds_are_those_of_the_results_that_share_no_frame() -> None:
    claims = _claims([[1.0] * 6] * 10, 1.0)
    separation, same = normalise(claims, independent=10), normalise(claims, independent=1)
    # χ² of 60 degrees of freedom: 40.482 and 83.298; of 6: 1.237 and 14.449.
    assert separation.nees_bounds == pytest.approx((40.482 / 60, 83.298 / 60), rel=0.01)
    assert same.nees_bounds == pytest.approx((1.237 / 6, 14.449 / 6), rel=0.03)


def test_axes_of_which_nothing_is_claimed_stand_in_no_figure() -> None:
    result = normalise(_claims([[1.0] * 6], [1.0, 1.0, 1.0, np.nan, np.nan, np.nan]), 1)
    for figures in (result.rms, result.largest, result.sigma, result.sigma_over_rms, result.coverage[0]):
        assert np.isfinite(figures[:3]).all()
        assert np.isnan(figures[3:]).all()
    assert result.histogram[3:].sum() == 0
    assert result.nees == pytest.approx(1.0)


def test_without_a_claim_there_is_no_figure_and_no_error() -> None:
    result = normalise(gathered([None, None]), 2)
    assert (result.judged, result.refused, result.independent) == (0, 2, 0)
    assert np.isnan([*result.rms, *result.coverage.ravel(), result.nees, *result.nees_bounds]).all()


def test_refused_results_claim_nothing() -> None:
    claims = of_outcomes([_finished(0.1), _finished(0.2, accepted=False), _finished(0.3, sigma_deg=np.nan)])
    assert (len(claims.errors), claims.refused) == (1, 2)
    np.testing.assert_allclose(np.degrees(claims.errors[0, 0]), 0.1)


def test_axes_that_were_not_solved_claim_nothing() -> None:
    outcome = _finished(0.1)
    estimate = outcome.trial.estimate
    assert estimate is not None
    solved = np.arange(6) < 3
    trial = replace(outcome.trial, estimate=replace(estimate, solved=solved))
    claims = of_outcomes([replace(outcome, trial=trial)])
    np.testing.assert_array_equal(np.isfinite(np.diagonal(claims.covariances[0])), solved)


def test_variances_of_two_halves_add_up() -> None:
    claims = of_differences([(_finished(0.3), _finished(0.0)), (_finished(0.0), _finished(0.0, accepted=False))])
    assert claims.refused == 1
    np.testing.assert_allclose(np.degrees(claims.errors[0, :3]), [0.3, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.diagonal(claims.covariances[0]), 2.0 * radians(0.1) ** 2)


def test_a_perturbation_is_carried_to_another_frame() -> None:
    T_b_a = se3.exp(np.array([0.4, -0.9, 0.2, 0.6, -0.1, 0.3]))
    xi = 1e-6 * np.array([1.0, -2.0, 0.5, 3.0, 1.0, -1.0])
    moved = se3.perturbation_log(T_b_a @ se3.perturbation(xi) @ se3.inverse(T_b_a))
    np.testing.assert_allclose(se3.adjoint(T_b_a) @ xi, moved, atol=1e-11)


def test_what_rests_on_an_unclaimed_axis_is_not_claimed() -> None:
    covariance = np.diag([1.0, 1.0, 1.0, np.nan, 1.0, 1.0])
    covariance[3, :] = covariance[:, 3] = np.nan
    quarter = se3.perturbation(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    turned = carried(covariance, se3.adjoint(quarter))
    np.testing.assert_array_equal(np.isfinite(np.diagonal(turned)), [True, True, True, True, False, True])
    nearly = carried(covariance, se3.adjoint(se3.perturbation(np.array([0.0, 0.0, 1e-4, 0.0, 0.0, 0.0]))))
    np.testing.assert_array_equal(np.isfinite(np.diagonal(nearly)), [True, True, True, False, True, True])


def test_shares_of_a_normal_distribution() -> None:
    assert within(0.6826895) == pytest.approx(1.0, abs=1e-6)
    assert within(0.9973002) == pytest.approx(3.0, abs=1e-6)
