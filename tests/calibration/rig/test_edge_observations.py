"""What checks and windows say of an edge, and what many of them leave behind."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.monitor.sequential_tests import BAD_SHARE, WEAK_TIMES
from coec.calibration.rig.edge_observations import (
    BIAS_TIMES,
    MAX_OBSERVATIONS,
    REACH,
    EdgeHistory,
    EdgeObservation,
    observation_of_check,
    observation_of_window,
    steps_at,
)
from coec.calibration.tracker import Measurement
from coec.calibration.types import Uncertainty
from coec.geometry import se3
from support.rigs import BIAS, NS, PLACE, POSES, SIGMA, TURN, edge_check, graph

POSE = POSES["front"] @ se3.inverse(POSES["roof"])
EDGE = graph([("front", "roof")]).edges[0]


def _observation(offset: np.ndarray, weak: bool = False) -> Observation:
    return Observation(
        stamp_ns=NS, pair_stamps_ns=(NS,), metrics=(), offset=offset, sigma=np.hypot(SIGMA, BIAS), noise=SIGMA,
        place=PLACE, dispersion=1.0, distance2=0.0, flagged=False, weak=weak, flagged_by_paper=None, causes=(),
    )  # fmt: skip


def test_a_check_puts_the_pair_where_its_optimum_is() -> None:
    result = observation_of_check("front-roof", POSE, _observation(TURN))
    assert result is not None
    np.testing.assert_allclose(se3.difference(result.T_a_b, POSE), TURN, atol=1e-12)
    sigma = np.sqrt(1.0 / result.information.diagonal())
    np.testing.assert_allclose(sigma[[0, 2, 3]], SIGMA[[0, 2, 3]], rtol=0.4)  # a little more, as it lies far away
    np.testing.assert_allclose(result.rig, np.maximum(BIAS, PLACE), rtol=1e-6)


def test_a_faint_check_says_less_and_one_of_bad_data_nothing() -> None:
    clear, faint = (observation_of_check("e", POSE, _observation(np.zeros(6), weak)) for weak in (False, True))
    assert clear is not None
    assert faint is not None
    np.testing.assert_allclose(clear.information, faint.information * WEAK_TIMES**2, rtol=1e-9)
    assert faint.log_bad > clear.log_bad
    cause = next(iter(CAUSES.values()))
    assert observation_of_check("e", POSE, replace(_observation(TURN), causes=(cause,))) is None
    assert observation_of_check("e", POSE, _observation(TURN), share=0.0) is None


def test_a_check_carries_since_when_its_pair_is_suspected_by_itself() -> None:
    for since_ns in (None, 5):
        result = observation_of_check("e", POSE, _observation(TURN), stepped_ns=since_ns)
        assert result is not None
        assert result.stepped_ns == since_ns


@pytest.mark.fault(
    "a check of a rig's pair is NaN, or comes where no pose is served", "it counts for nothing, or is refused"
)
def test_hostile_checks_say_nothing() -> None:
    assert observation_of_check("e", POSE, _observation(np.full(6, np.nan))) is None
    only_turns = observation_of_check("e", POSE, _observation(np.array([0.01, 0.0, 0.0, np.nan, 0.0, 0.0])))
    assert only_turns is not None
    assert not only_turns.information[3:].any()
    with pytest.raises(ValueError, match="e: a pose must be a rigid transform"):
        observation_of_check("e", np.full((4, 4), np.inf), _observation(TURN))


def test_a_window_of_rotations_determines_rotations_and_what_windows_share_counts() -> None:
    noise = np.diag([*SIGMA[:3] ** 2, np.nan, np.nan, np.nan])
    noise[3:, :] = noise[:, 3:] = np.nan
    window = Measurement(POSE, Uncertainty(noise, {"lens_down": SIGMA * np.eye(6)[0]}, 9.0), NS)
    result = observation_of_window("e", window)
    assert result is not None
    assert not result.information[3:].any()
    assert result.information[0, 0] == pytest.approx(1.0 / (2.0 * SIGMA[0] ** 2 + (BIAS_TIMES * BIAS[0]) ** 2))
    assert observation_of_window("e", replace(window, uncertainty=Uncertainty.unknown())) is None


def test_a_step_is_the_difference_of_two_robust_means() -> None:
    rng, history = np.random.default_rng(1), EdgeHistory.at(EDGE.T_a_b, BIAS)
    for turn in range(MAX_OBSERVATIONS):
        error = SIGMA * rng.normal(size=6) + (TURN if turn >= 16 else 0.0)
        if turn in (5, 18):
            error = np.array([radians(3.0), 0.0, radians(-2.0), 0.1, 0.0, 0.0])
        history = history.after(edge_check(EDGE, POSES, float(turn), error), calm=True)
    steps = steps_at(history, [16 * NS, 20 * NS])
    away = steps.xi[0] - TURN
    assert float(away @ np.linalg.solve(steps.covariance[0], away)) < 22.5
    assert steps.observations[0] == pytest.approx(7.0, abs=0.3)  # of eight one is bad
    assert steps.log_stepped[0] > steps.log_stepped[1]  # it was then, and not later


def test_old_observations_are_counted_together_in_calm_and_forgotten_in_doubt() -> None:
    rng = np.random.default_rng(2)
    calm = doubt = EdgeHistory.at(EDGE.T_a_b, BIAS)
    for turn in range(3 * MAX_OBSERVATIONS):
        seen = edge_check(EDGE, POSES, float(turn), PLACE + 0.1 * SIGMA * rng.normal(size=6))
        calm, doubt = calm.after(seen, calm=True), doubt.after(seen, calm=False)
    assert len(calm.observations) == len(doubt.observations) == MAX_OBSERVATIONS
    np.testing.assert_allclose(calm.mean, PLACE, rtol=0.15)
    np.testing.assert_array_equal(doubt.mean, 0.0)


def window(xi: np.ndarray, sigma: np.ndarray, at_s: float) -> EdgeObservation:
    """An accepted one that puts the edge at ξ from where it was."""
    result = observation_of_window(
        EDGE.name, Measurement(se3.perturb(EDGE.T_a_b, xi), Uncertainty.independent(sigma), round(at_s * NS))
    )
    assert result is not None
    return result


def test_a_window_against_an_origin_that_windows_reported_is_known_better_than_the_bias_of_observations() -> None:
    known = EdgeHistory.served(EDGE.T_a_b, SIGMA)
    steps = steps_at(known.after(window(TURN, SIGMA, 9.0), calm=True), [5 * NS])
    np.testing.assert_allclose(steps.xi[0], TURN, atol=1e-3)
    np.testing.assert_allclose(np.sqrt(steps.covariance[0].diagonal()), np.sqrt(2.0) * SIGMA, rtol=1e-2)
    assert steps.observations[0] == 1.0
    unknown = EdgeHistory.at(EDGE.T_a_b, SIGMA).after(window(TURN, SIGMA, 9.0), calm=True)
    assert np.sqrt(steps_at(unknown, [5 * NS]).covariance[0, 1, 1]) > BIAS_TIMES * BIAS[1]


def test_what_a_window_says_of_a_step_is_the_integral_over_all_steps() -> None:
    """Of one axis, by the sum over a grid."""
    sigma = np.array([SIGMA[0], *[np.nan] * 5])
    known = EdgeHistory.served(EDGE.T_a_b, sigma)
    checked = known
    for turn in range(4):
        checked = checked.after(edge_check(EDGE, POSES, float(turn), np.zeros(6)), calm=True)
    for off in (0.0, 2.0 * SIGMA[0], 8.0 * TURN[1]):
        seen = window(np.array([off, *[0.0] * 5]), sigma, 9.0)
        before, after = (
            (steps_at(checked, [20 * NS, 2 * NS])),
            steps_at(checked.after(seen, calm=True), [20 * NS, 2 * NS]),
        )
        density = np.log(normal(off, 2.0 * SIGMA[0] ** 2) * (1.0 - BAD_SHARE) + normal(off, REACH[0] ** 2) * BAD_SHARE)
        assert after.log_still - before.log_still == pytest.approx(density, abs=1e-6)
        assert after.log_stepped[0] - before.log_stepped[0] == pytest.approx(density, abs=1e-6), "it begins before it"
        x = np.linspace(-0.2, 0.2, 200_001)
        step = normal(x - before.xi[1, 0], before.covariance[1, 0, 0])
        good = np.sum(step * normal(x - off, 2.0 * SIGMA[0] ** 2)) * (x[1] - x[0])
        density = np.log(good * (1.0 - BAD_SHARE) + normal(off, REACH[0] ** 2) * BAD_SHARE)
        assert after.log_stepped[1] - before.log_stepped[1] == pytest.approx(density, abs=0.01)


def normal(x: np.ndarray | float, variance: float) -> np.ndarray:
    return np.asarray(np.exp(-0.5 * np.square(x) / variance) / np.sqrt(2.0 * np.pi * variance))


def test_a_window_that_contradicts_all_observations_moves_no_step() -> None:
    known = EdgeHistory.served(EDGE.T_a_b, SIGMA)
    for turn in range(8):
        known = known.after(edge_check(EDGE, POSES, float(turn), np.zeros(6)), calm=True)
    steps = steps_at(known.after(window(10.0 * TURN, SIGMA, 9.0), calm=True), [4 * NS])
    np.testing.assert_allclose(steps.xi[0], 0.0, atol=1e-6)
    assert steps.observations[0] == pytest.approx(4.0, abs=0.2)


def test_among_observations_that_all_contradict_each_other_a_window_determines_the_right_one() -> None:
    rng, known = np.random.default_rng(4), EdgeHistory.served(EDGE.T_a_b, SIGMA)
    for turn in range(4):
        known = known.after(edge_check(EDGE, POSES, float(turn), SIGMA * rng.normal(size=6)), calm=True)
    for turn in range(4, 8):
        error = TURN if turn == 6 else radians(3.0) * rng.normal(size=6)
        known = known.after(edge_check(EDGE, POSES, float(turn), error), calm=True)
    steps = steps_at(known.after(window(TURN, SIGMA, 5.0), calm=True), [4 * NS])
    np.testing.assert_allclose(steps.xi[0], TURN, atol=4.0 * SIGMA[3])
    np.testing.assert_allclose(steps.xi[0, :3], TURN[:3], atol=2.0 * SIGMA[0])
    assert steps.observations[0] == pytest.approx(2.0, abs=0.1)
