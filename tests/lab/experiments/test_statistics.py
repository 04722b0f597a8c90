"""Statistics of an evaluation, on outcomes whose figures are known by hand."""

from __future__ import annotations

from math import radians

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import Decision, Estimate, Optimum, StopReason, Uncertainty, Verdict
from coec.geometry import se3
from coec_lab.experiments.evaluation_documents import frames_point, slice_point
from coec_lab.experiments.solve_statistics import (
    NOT_SOLVED,
    SolveOutcome,
    Trial,
    score,
    spread,
    summarise,
    worst,
)

REFERENCE = se3.exp(np.array([1.2, -1.2, 1.2, 0.1, -0.3, 0.8]))
FAR = se3.perturb(REFERENCE, np.array([0.0, radians(10.0), 0.0, 0.0, 0.0, 0.0]))


def _xi(*deg_m: float) -> NDArray[np.float64]:
    values = np.zeros(6)
    values[: len(deg_m)] = deg_m
    values[:3] = np.radians(values[:3])
    return values


def _estimate(error: NDArray[np.float64], accepted: bool, sigma: float = np.nan) -> Estimate:
    decision = Decision.ACCEPTED if accepted else Decision.FAILED
    nan = np.full(6, np.nan)
    optimum = Optimum(
        T_camera_lidar=se3.perturb(REFERENCE, error),
        score=1.0,
        score_at_start=0.5,
        mi=1.0,
        overlap=1.0,
        points_in_view=1,
        evaluations=40,
        stop_reason=StopReason.TOLERANCE,
        first_derivative=nan,
        second_derivative=nan,
    )
    return Estimate(
        "w",
        0,
        1,
        optimum,
        Verdict(decision, (), ()),
        nan,
        Uncertainty.independent(np.full(6, sigma)),
        np.ones(6, np.bool_),
        np.zeros(6, np.bool_),
        {},
        "",
        "",
    )


def _outcome(
    *deg_m: float, accepted: bool = True, dof: int = 3, solve_s: float = 1.0, sigma: float = 0.1
) -> SolveOutcome:
    return score(Trial(FAR, _estimate(_xi(*deg_m), accepted, sigma), solve_s), REFERENCE, dof)


def test_errors_are_counted_from_the_reference_about_the_camera_axes() -> None:
    outcome = _outcome(0.3, -0.4, 0.0, 0.03, 0.0, -0.04)
    np.testing.assert_allclose(outcome.error, _xi(0.3, -0.4, 0.0, 0.03, 0.0, -0.04), atol=1e-12)
    assert outcome.rotation_rad == pytest.approx(radians(0.5))
    assert outcome.translation_m == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("deg_m", "dof", "hit"),
    [
        ((0.499,), 3, True),
        ((0.501,), 3, False),
        ((0.499, 0, 0, 5.0), 3, True),
        ((0.499, 0, 0, 0.199), 6, True),
        ((0.499, 0, 0, 0.201), 6, False),
        ((0.501, 0, 0, 0.0), 6, False),
    ],
)
def test_a_hit_is_near_in_what_was_searched(deg_m: tuple[float, ...], dof: int, hit: bool) -> None:
    assert _outcome(*deg_m, dof=dof).hit is hit


def test_without_an_estimate_it_ends_where_it_started() -> None:
    outcome = score(Trial(FAR, None, 0.1), REFERENCE, 3)
    assert outcome.rotation_rad == pytest.approx(radians(10.0))
    assert not outcome.hit
    assert not outcome.accepted
    statistics = summarise([outcome])
    assert statistics.stop_reasons == {NOT_SOLVED: 1}
    assert np.isnan(statistics.evaluations.median)
    assert statistics.classified_correctly == 1.0


def test_bias_and_spread_are_those_of_the_hits() -> None:
    statistics = summarise([_outcome(0.1, -0.2), _outcome(0.3, -0.2), _outcome(30.0, 40.0, accepted=False)])
    np.testing.assert_allclose(statistics.bias, _xi(0.2, -0.2), atol=1e-9)
    np.testing.assert_allclose(statistics.std, _xi(np.sqrt(0.02), 0.0), atol=1e-9)
    np.testing.assert_allclose(statistics.rms, _xi(np.sqrt(0.05), 0.2), atol=1e-9)
    np.testing.assert_allclose(statistics.sigma, 0.1)


def test_errors_are_those_of_all_starts() -> None:
    statistics = summarise([_outcome(0.1), _outcome(0.2), _outcome(30.0)])
    assert (statistics.starts, statistics.hits, statistics.hit_rate) == (3, 2, 2 / 3)
    assert statistics.rotation_rad.median == pytest.approx(radians(0.2))
    assert statistics.rotation_rad.max == pytest.approx(radians(30.0))
    np.testing.assert_allclose(statistics.median, _xi(0.2), atol=1e-9)
    assert statistics.rotation_rad.p95 == pytest.approx(radians(0.2 + 0.9 * 29.8))


def test_verdicts_are_counted_against_the_truth() -> None:
    outcomes = [
        *[_outcome(0.1)] * 4,
        *[_outcome(0.1, accepted=False)] * 3,
        *[_outcome(9.0)] * 2,
        _outcome(9.0, accepted=False),
    ]
    statistics = summarise(outcomes)
    verdicts = statistics.verdicts
    assert (verdicts.accepted_hits, verdicts.failed_hits) == (4, 3)
    assert (verdicts.accepted_misses, verdicts.failed_misses) == (2, 1)
    assert statistics.classified_correctly == 0.5


def test_no_hit_has_no_bias_and_one_hit_no_spread() -> None:
    none, one = summarise([_outcome(9.0)]), summarise([_outcome(0.1)])
    assert np.isnan([*none.bias, *none.std, *none.rms, *none.sigma]).all()
    assert np.isfinite(one.bias).all()
    assert np.isnan(one.std).all()


def test_claims_that_are_missing_are_left_out_of_the_median() -> None:
    outcomes = [_outcome(0.1, sigma=np.nan), _outcome(0.1, sigma=0.3), _outcome(0.1, sigma=0.1)]
    np.testing.assert_allclose(summarise(outcomes).sigma, 0.2)


def test_nothing_cannot_be_summarised() -> None:
    with pytest.raises(ValueError, match="at least one"):
        summarise([])


def test_worst_is_measured_by_the_limits() -> None:
    shifted, turned = _outcome(0.1, 0, 0, 0.5, dof=6), _outcome(0.6, dof=6)
    assert worst([turned, shifted]) == 1
    assert worst([_outcome(0.6), _outcome(0.1, 0, 0, 0.5)]) == 0


def test_spread_of_seconds() -> None:
    values = spread(range(101))
    assert (values.median, values.p95, values.max) == (50.0, 95.0, 100.0)


def test_frames_point_counts_hits_and_misses() -> None:
    point = frames_point(5, [_outcome(0.1), _outcome(2.0), _outcome(0.3), _outcome(0.2)])
    assert (point.frames, point.subsets, point.hit_rate) == (5, 4, 0.75)
    assert point.rotation_deg.max == pytest.approx(2.0)


def test_claims_about_the_rotation_are_the_root_of_the_sum_of_variances() -> None:
    point = frames_point(5, [_outcome(0.1, sigma=0.01), _outcome(0.1, sigma=0.03), _outcome(0.1, sigma=np.nan)])
    assert point.sigma_deg == pytest.approx(np.degrees(np.sqrt(3.0) * 0.02))
    assert frames_point(1, [_outcome(0.1, sigma=np.nan)]).sigma_deg is None


def test_slice_point_takes_the_slices_together() -> None:
    point = slice_point(7.5, [(3, [_outcome(0.1), _outcome(2.0)]), (5, [_outcome(0.3)]), (9, [_outcome(0.2)])])
    assert (point.length_s, point.slices, point.pairs, point.solves) == (7.5, 3, 5.0, 4)
    assert point.hit_rate == 0.75
    assert point.rotation_deg.max == pytest.approx(2.0)
