"""What a trial of a few pairs predicts of a calibration of more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.types import Decision, Estimate, Metric, Reason, Verdict
from coec.reports.recording_fitness import reasons_that_stay
from support.estimates import estimate

MOTION = Reason("motion", "12 frames are worth 2.0 independent samples")


def trial(*metrics: Metric, pairs: int = 12) -> Estimate:
    reasons = tuple(Reason(metric.name, f"{metric.name} says no") for metric in metrics if not metric.passed)
    return replace(
        estimate(1, Decision.FAILED), pairs=pairs, verdict=Verdict(Decision.FAILED, metrics, (*reasons, MOTION))
    )


def codes(estimate: Estimate, pairs: int) -> list[str]:
    return [reason.code for reason in reasons_that_stay(estimate, pairs)]


@pytest.mark.parametrize(
    ("metric", "at_best"),
    [
        (Metric("sigma_deg", 1.2, 0.3, at_least=False), True),
        (Metric("sigma_deg", 1.4, 0.3, at_least=False), False),
        (Metric("range_edges", 250.0, 800.0, at_least=True), True),
        (Metric("range_edges", 150.0, 800.0, at_least=True), False),
        (Metric("edge_contrast", 3.5, 6.0, at_least=True), True),
        (Metric("edge_contrast", 2.4, 6.0, at_least=True), False),
        (Metric("overlap", 0.4, 0.5, at_least=True), False),
        (Metric("sigma_deg", np.nan, 0.3, at_least=False), True),
    ],
)
def test_what_four_times_as_many_pairs_may_remedy_is_not_predicted(metric: Metric, at_best: bool) -> None:
    assert codes(trial(metric), 48) == ([] if at_best else [metric.name, "motion"])


@pytest.mark.parametrize("pairs", [3, 12])
def test_a_trial_of_all_pairs_is_the_calibration(pairs: int) -> None:
    assert codes(trial(Metric("sigma_deg", 0.34, 0.3, at_least=False)), pairs) == ["sigma_deg", "motion"]


def test_a_figure_next_to_its_limit_is_not_predicted_to_fail() -> None:
    assert codes(trial(Metric("sigma_deg", 0.32, 0.3, at_least=False)), 12) == []
    assert codes(trial(Metric("edge_contrast", 5.6, 6.0, at_least=True)), 12) == []


def test_nothing_is_predicted_of_an_accepted_trial() -> None:
    assert reasons_that_stay(estimate(1), 25) == ()
