"""Equation (2): each limit fails on its own, and a figure that could not be computed never passes."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.figures import FIGURES
from coec.calibration.objective.edges import IndependentSamples
from coec.calibration.objective.fused import Scale
from coec.calibration.objective.landscape import Curvature
from coec.calibration.objective.mutual_information import Evaluation
from coec.calibration.search.change_point import ChangePoint
from coec.calibration.search.local_search import SearchResult
from coec.calibration.types import (
    INTRINSICS_OFF,
    MOVED,
    Decision,
    Metric,
    Reason,
    StopReason,
    Uncertainty,
    Verdict,
)
from coec.calibration.uncertainty.covariance import AssessedOptimum
from coec.calibration.uncertainty.posterior import Hypothesis, OtherCentre, Posterior
from coec.calibration.verdict import (
    change_metric,
    counted_once,
    intrinsics_metric,
    judge,
    on_the_sharpest,
    optimum_metrics,
    range_metric,
    reason_details,
    repetition_metric,
    shape_metrics,
)
from coec.config import CalibrationConfig, SearchConfig, VerdictConfig
from coec.geometry import se3
from support.scenes import corner_motions, corner_window

LIMITS = VerdictConfig()
GOOD = Evaluation(score=1.4, frame_scores=np.full(10, 1.4), mi=1.4, overlap=0.9, points_in_view=10_000)
PEAK = Curvature(
    first_derivative=np.array([0.1, -0.1, 0.05, np.nan, np.nan, np.nan]),
    second_derivative=np.array([250.0, 260.0, 300.0, np.nan, np.nan, np.nan]),
)
SHARP = np.array([6e-4, 6e-4, 1e-3, np.nan, np.nan, np.nan])
VAGUE, UNKNOWN = 100.0 * SHARP, np.full(6, np.nan)
FRAMES = 10
TOLERANCE = StopReason.TOLERANCE
SLOPE = replace(PEAK, first_derivative=PEAK.first_derivative * 100)
PLAIN = replace(PEAK, first_derivative=PEAK.first_derivative / 100, second_derivative=PEAK.second_derivative / 100)
OUTSTANDING = (
    Metric("edge_contrast", 9.0, LIMITS.min_edge_contrast, at_least=True),
    Metric("runner_up", 0.5, LIMITS.max_runner_up, at_least=False),
)


def posterior_of(significance: float = 20.0, **probabilities: float) -> Posterior:
    """Hypotheses by name, with their probabilities."""
    every = tuple(Hypothesis(name, p, np.zeros(13), np.eye(13)) for name, p in probabilities.items())
    return Posterior(every, 0.1, significance)


def verdict_on(
    evaluation: Evaluation = GOOD,
    curvature: Curvature = PEAK,
    stop: StopReason = StopReason.TOLERANCE,
    of_objective: tuple[Metric, ...] = OUTSTANDING,
    sigma: NDArray[np.float64] = SHARP,
    observations: float = float(FRAMES),
) -> Verdict:
    return judge((*of_objective, *shape_metrics(evaluation, curvature, sigma, LIMITS)), stop, observations, FRAMES)


def test_a_peak_with_everything_in_view_is_accepted() -> None:
    verdict = verdict_on()
    assert verdict.decision is Decision.ACCEPTED
    assert verdict.reasons == ()
    assert len(verdict.metrics) == 6
    assert all(metric.passed for metric in verdict.metrics)


@pytest.mark.parametrize(
    ("verdict", "code"),
    [
        (verdict_on(replace(GOOD, overlap=0.2)), "overlap"),
        (verdict_on(curvature=SLOPE), "newton_step_deg"),
        (verdict_on(curvature=PLAIN), "peakedness_per_deg2"),
        (verdict_on(stop=StopReason.AT_BOUND), "optimum_at_bound"),
        (verdict_on(stop=StopReason.EVALUATIONS), "evaluations_exhausted"),
        (verdict_on(sigma=VAGUE), "sigma_deg"),
        (verdict_on(sigma=UNKNOWN, observations=np.nan), "sigma_deg"),
        (verdict_on(of_objective=(replace(OUTSTANDING[0], value=3.0),)), "edge_contrast"),
        (verdict_on(of_objective=(replace(OUTSTANDING[1], value=0.95),)), "runner_up"),
        (verdict_on(of_objective=(Metric("mi_over_unrelated", 1.1, 1.2, at_least=True),)), "mi_over_unrelated"),
    ],
)
def test_each_limit_fails_with_its_own_reason(verdict: Verdict, code: str) -> None:
    assert verdict.decision is Decision.FAILED
    assert [reason.code for reason in verdict.reasons] == [code]


def test_a_metric_that_fails_says_its_value_and_its_limit() -> None:
    (reason,) = verdict_on(replace(GOOD, overlap=0.25)).reasons
    assert "0.25" in reason.text
    assert f"{LIMITS.min_overlap:g}" in reason.text


@pytest.mark.parametrize(
    ("sigma", "text"),
    [
        ([0.1, 0.73, 0.2], "yaw is only known to ±0.73°, limit 0.30°"),
        ([0.412, 0.73, 0.2], "pitch is only known to ±0.41°, yaw to ±0.73°, limit 0.30°"),
        ([0.1, 0.2, 0.3001], "roll is only known to ±0.3001°, limit 0.30°"),
        ([np.nan, 0.2, 0.1], f"{FIGURES['sigma_deg'].fails}: unknown, limit 0.3°"),
    ],
)
def test_a_rotation_that_is_not_known_well_enough_is_named_with_unit_and_limit(sigma: list[float], text: str) -> None:
    radians = np.radians([*sigma, np.nan, np.nan, np.nan])
    (reason,) = judge(shape_metrics(GOOD, PEAK, radians, LIMITS), TOLERANCE, 10.0, FRAMES, sigma=radians).reasons
    assert reason == Reason("sigma_deg", text)


def test_a_translation_that_is_not_known_well_enough_is_named_with_unit_and_limit() -> None:
    searched = replace(PEAK, first_derivative=np.full(6, 0.1), second_derivative=np.full(6, 300.0))
    sigma = np.array([*SHARP[:3], 0.02, 0.034, 0.123])
    (reason,) = judge(shape_metrics(GOOD, searched, sigma, LIMITS), TOLERANCE, 10.0, FRAMES, sigma=sigma).reasons
    assert reason == Reason("sigma_m", "position forward is only known to ±0.12 m, limit 0.10 m")


def test_a_metric_that_fails_says_its_unit() -> None:
    (reason,) = verdict_on(of_objective=(replace(OUTSTANDING[0], value=3.25),)).reasons
    assert reason.text.endswith(": 3.25 σ, limit 6 σ")


def test_a_saddle_is_not_a_maximum() -> None:
    saddle = replace(PEAK, second_derivative=PEAK.second_derivative * [1, -1, 1, 1, 1, 1])
    assert [reason.code for reason in verdict_on(curvature=saddle).reasons] == [
        "newton_step_deg",
        "peakedness_per_deg2",
    ]


@pytest.mark.fault("a figure that is no number", "it passes no limit")
@pytest.mark.parametrize("at_least", [True, False])
def test_what_is_not_a_number_never_passes(at_least: bool) -> None:
    assert not Metric("any", float("nan"), 0.0, at_least).passed


@pytest.mark.parametrize("score", [0.0, -0.0, -1e-13, -2.5])
def test_a_peak_of_a_score_that_is_not_above_zero_is_none(score: float) -> None:
    """The fused objective counts from the mean of other poses: below it, a ripple is no summit."""
    verdict = verdict_on(replace(GOOD, score=score))
    assert verdict.decision is Decision.FAILED
    assert [reason.code for reason in verdict.reasons] == ["peakedness_per_deg2"]


def test_peakedness_is_the_curvature_over_the_score() -> None:
    np.testing.assert_allclose(PEAK.peakedness(2.0), PEAK.second_derivative[:3] / 2.0)
    half = {m.name: m.value for m in shape_metrics(replace(GOOD, score=2.8), PEAK, SHARP, LIMITS)}[
        "peakedness_per_deg2"
    ]
    whole = {m.name: m.value for m in shape_metrics(GOOD, PEAK, SHARP, LIMITS)}["peakedness_per_deg2"]
    assert half == pytest.approx(whole / 2.0)
    assert whole == pytest.approx(250.0 * np.radians(1.0) ** 2 / 1.4)


def test_a_window_that_is_too_uncertain_because_it_saw_one_scene_needs_motion() -> None:
    assert [reason.code for reason in verdict_on(sigma=VAGUE, observations=2.0).reasons] == ["sigma_deg", "motion"]
    assert [reason.code for reason in verdict_on(sigma=VAGUE, observations=9.0).reasons] == ["sigma_deg"]
    assert verdict_on(observations=2.0).decision is Decision.ACCEPTED


def test_range_edges_that_frames_have_in_common_count_once() -> None:
    result = (Metric("range_edges", 3000.0, 1000.0, at_least=True), OUTSTANDING[0])
    once = {metric.name: metric.value for metric in counted_once(result, 2.0, FRAMES)}
    assert once == {"range_edges": 600.0, "edge_contrast": OUTSTANDING[0].value}
    assert counted_once(result, float("nan"), FRAMES) == result


def test_what_fits_by_a_few_edges_that_all_frames_share_is_not_accepted() -> None:
    """The lines along a road, or one board before a wall."""
    by_lines = IndependentSamples(count=2.5, significance=8.0)
    verdict = verdict_on(of_objective=(*OUTSTANDING, *repetition_metric(by_lines, LIMITS)))
    assert [reason.code for reason in verdict.reasons] == ["edges_once"]
    past_trees = repetition_metric(IndependentSamples(count=3.0, significance=25.0), LIMITS)
    assert verdict_on(of_objective=(*OUTSTANDING, *past_trees)).decision is Decision.ACCEPTED


def test_what_fits_by_markings_alone_is_not_accepted() -> None:
    """A road by night, where nothing but its paint is lit."""
    verdict = verdict_on(of_objective=(*OUTSTANDING, *range_metric(2.9, LIMITS)))
    assert [reason.code for reason in verdict.reasons] == ["range_significance"]
    assert verdict_on(of_objective=(*OUTSTANDING, *range_metric(8.0, LIMITS))).decision is Decision.ACCEPTED


def test_an_objective_without_edges_has_none_to_count_once() -> None:
    assert repetition_metric(None, LIMITS) == ()
    assert range_metric(None, LIMITS) == ()


def assessed(samples: float = np.nan, significance: float = 20.0, rivals: tuple[float, ...] = ()) -> AssessedOptimum:
    uncertainty = replace(Uncertainty.unknown(), independent_samples=samples)
    search, posterior = SearchResult(np.eye(4), 10, TOLERANCE), posterior_of(significance=significance, nominal=1.0)
    return AssessedOptimum(search, (), PEAK, posterior, None, None, rivals, None, uncertainty, SHARP)


@pytest.mark.parametrize(
    ("dof", "frames", "samples", "stricter"),
    [(3, 1, 1.0, True), (3, 10, 2.5, True), (3, 10, 8.0, False), (3, 10, np.nan, False), (6, 10, 2.5, False)],
)
def test_a_rotation_from_one_scene_needs_more_contrast(
    dof: Literal[3, 6], frames: int, samples: float, stricter: bool
) -> None:
    config = CalibrationConfig(search=SearchConfig(dof=dof))
    contrast, *_ = optimum_metrics(OUTSTANDING, GOOD, None, assessed(samples), None, frames, config)
    assert (contrast.name, contrast.limit > LIMITS.min_edge_contrast) == ("edge_contrast", stricter)


def on_sharp(significance: float, rivals: tuple[float, ...] = (), runner: float = 0.95) -> dict[str, float]:
    """Edge contrast and runner-up on blurred and sharp edges; 4 of contrast at the optimum itself."""
    optimum = assessed(significance=significance, rivals=rivals)
    blurred = (OUTSTANDING[0], replace(OUTSTANDING[1], value=runner))
    evaluation = replace(GOOD, edge_contrast=4.0)
    return {m.name: m.value for m in on_the_sharpest(blurred, evaluation, Scale(mean=1.0, deviation=2.0), optimum)}


def test_the_sharpest_edges_count_with_lens_and_held_centre_at_their_most_probable() -> None:
    """A held centre that is off by a centimetre displaces near edges by more than they are wide."""
    assert on_sharp(17.0)["edge_contrast"] == 8.0
    assert on_sharp(5.0)["edge_contrast"] == 4.0
    assert on_sharp(40.0)["edge_contrast"] == OUTSTANDING[0].value


def test_another_centre_of_the_camera_is_a_rival_though_blurred_edges_know_none() -> None:
    optimum = replace(assessed(significance=17.0), other_centre=OtherCentre(5, 0.9))
    blurred = (OUTSTANDING[0], replace(OUTSTANDING[1], value=0.3))
    _, runner_up = on_the_sharpest(blurred, GOOD, Scale(mean=1.0, deviation=2.0), optimum)
    assert (runner_up.name, runner_up.value, runner_up.passed) == ("runner_up", 0.9, False)


def test_a_rival_that_only_blurred_edges_fit_is_none() -> None:
    assert on_sharp(17.0, rivals=(9.0, 3.0))["runner_up"] == 0.5
    assert on_sharp(17.0, rivals=(9.0, float("inf")))["runner_up"] == 0.95
    assert on_sharp(17.0, rivals=(-5.0,))["runner_up"] == 0.0
    assert on_sharp(17.0)["runner_up"] == 0.95


def changed(gain: float = 9.0, turn_deg: float = 1.0, support: float = 8.0, likeness: float = 0.9) -> ChangePoint:
    after = se3.perturbation(np.radians([turn_deg, 0.0, 0.0, 0.0, 0.0, 0.0]))
    return ChangePoint(3, np.eye(4), after, gain, support, likeness)


def verdict_after(change: ChangePoint | None) -> Verdict:
    return judge(
        change_metric(change, LIMITS),
        StopReason.TOLERANCE,
        FRAMES,
        FRAMES,
        {MOVED: ", by 1.0° between 20.4 and 21.6 s"},
    )


def test_a_knock_within_the_window_refuses_it_and_says_when() -> None:
    verdict = verdict_after(changed())
    (reason,) = verdict.reasons
    assert reason.code == "moved_within_window"
    assert "the camera moved while the window was recorded, by 1.0° between 20.4 and 21.6 s: 9 σ, limit" in reason.text


@pytest.mark.parametrize(
    "change",
    [
        changed(gain=2.0),
        changed(turn_deg=0.2),
        changed(support=3.0),
        changed(likeness=0.3),
        None,
    ],
    ids=["chance", "small", "nothing to see", "the scene changed", "not looked for"],
)
def test_what_is_no_knock_does_not_refuse(change: ChangePoint | None) -> None:
    assert verdict_after(change).decision is Decision.ACCEPTED


@pytest.mark.parametrize(
    ("distribution", "refused"),
    [
        (posterior_of(nominal=0.01, lens_off=0.99), True),
        (posterior_of(nominal=0.4, lens_off=0.3, focal_length_off=0.3), True),
        (posterior_of(nominal=0.7, principal_point_off=0.3), False),
        (posterior_of(nominal=0.01, clocks_free=0.99), False),
    ],
    ids=["another lens", "a lens that is off one way or another", "one that is not certain", "other clocks"],
)
def test_a_window_through_another_lens_is_refused_for_that(distribution: Posterior, refused: bool) -> None:
    verdict = verdict_on(of_objective=(*OUTSTANDING, *intrinsics_metric(distribution, LIMITS)))
    assert [reason.code for reason in verdict.reasons] == ([INTRINSICS_OFF] if refused else [])
    assert verdict.shows_another_lens is refused
    if refused:
        assert verdict.is_inconclusive


@pytest.mark.parametrize(("probability", "is_named"), [(0.12, True), (0.02, False), (0.7, False)])
def test_an_uncertain_rotation_names_a_lens_that_is_not_excluded(probability: float, is_named: bool) -> None:
    """Above even odds, the other lens is a reason of its own."""
    distribution = posterior_of(nominal=1.0 - probability, cropped_down=probability)
    text = reason_details(distribution, None, corner_window(corner_motions()))["sigma_deg"]
    assert (f"other intrinsics have a probability of {probability:.0%}: focal length +0.0 %" in text) is is_named
