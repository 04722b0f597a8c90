"""Equation (2): each limit fails on its own, and a figure that could not be computed never passes."""

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.confidence import Curvature
from coec.calibration.objective import Evaluation
from coec.calibration.values import Decision, Metric, StopReason
from coec.calibration.verdict import judge
from coec.config import VerdictConfig

LIMITS = VerdictConfig()
GOOD = Evaluation(score=1.4, frame_scores=np.full(10, 1.4), mi=1.4, overlap=0.9, points_in_view=10_000)
PEAK = Curvature(
    first_derivative=np.array([0.1, -0.1, 0.05, np.nan, np.nan, np.nan]),
    second_derivative=np.array([250.0, 260.0, 300.0, np.nan, np.nan, np.nan]),
    sigma=np.full(6, np.nan),
)
SLOPE = replace(PEAK, first_derivative=PEAK.first_derivative * 100)
PLAIN = replace(PEAK, second_derivative=PEAK.second_derivative / 100)


def test_a_peak_with_everything_in_view_is_accepted() -> None:
    verdict = judge(GOOD, 0.9, PEAK, StopReason.TOLERANCE, LIMITS)
    assert verdict.decision is Decision.ACCEPTED
    assert verdict.reasons == ()
    assert all(metric.passed for metric in verdict.metrics)


@pytest.mark.parametrize(
    ("evaluation", "unrelated", "curvature", "stop", "code"),
    [
        (GOOD, 1.3, PEAK, StopReason.TOLERANCE, "mi_over_unrelated"),
        (replace(GOOD, overlap=0.2), 0.9, PEAK, StopReason.TOLERANCE, "overlap"),
        (GOOD, 0.9, SLOPE, StopReason.TOLERANCE, "newton_step_deg"),
        (GOOD, 0.9, PLAIN, StopReason.TOLERANCE, "peakedness_per_deg2"),
        (GOOD, 0.9, PEAK, StopReason.AT_BOUND, "optimum_at_bound"),
        (GOOD, 0.9, PEAK, StopReason.EVALUATIONS, "evaluations_exhausted"),
    ],
)  # fmt: skip
def test_each_limit_fails_with_its_own_reason(
    evaluation: Evaluation, unrelated: float, curvature: Curvature, stop: StopReason, code: str
) -> None:
    verdict = judge(evaluation, unrelated, curvature, stop, LIMITS)
    assert verdict.decision is Decision.FAILED
    assert code in {reason.code for reason in verdict.reasons}


def test_a_saddle_is_not_a_maximum() -> None:
    saddle = replace(PEAK, second_derivative=PEAK.second_derivative * [1, -1, 1, 1, 1, 1])
    codes = {reason.code for reason in judge(GOOD, 0.9, saddle, StopReason.TOLERANCE, LIMITS).reasons}
    assert codes == {"newton_step_deg", "peakedness_per_deg2"}


@pytest.mark.parametrize("at_least", [True, False])
def test_what_is_not_a_number_never_passes(at_least: bool) -> None:
    assert not Metric("any", float("nan"), 0.0, at_least).passed
