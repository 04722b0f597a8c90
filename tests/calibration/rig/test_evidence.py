"""What checks and windows say of an edge, and what many of them leave behind."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.likelihood import WEAK_TIMES
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.rig.evidence import BIAS_TIMES, of_check, of_window
from coec.calibration.rig.steps import MOST_LOOKS, History, steps_at
from coec.calibration.tracker import Measurement
from coec.calibration.types import Uncertainty
from coec.geometry import se3
from rigs import BIAS, NS, PLACE, POSES, SIGMA, TURN, graph, look

POSE = POSES["front"] @ se3.inverse(POSES["roof"])
EDGE = graph([("front", "roof")]).edges[0]


def _observation(offset: np.ndarray, weak: bool = False) -> Observation:
    return Observation(
        stamp_ns=NS, pair_stamps_ns=(NS,), metrics=(), offset=offset, sigma=np.hypot(SIGMA, BIAS), noise=SIGMA,
        place=PLACE, dispersion=1.0, distance2=0.0, flagged=False, weak=weak, flagged_by_paper=None, causes=(),
    )  # fmt: skip


def test_a_check_puts_the_pair_where_its_optimum_is() -> None:
    found = of_check("front-roof", POSE, _observation(TURN))
    assert found is not None
    np.testing.assert_allclose(se3.difference(found.T_a_b, POSE), TURN, atol=1e-12)
    sigma = np.sqrt(1.0 / found.information.diagonal())
    np.testing.assert_allclose(sigma[[0, 2, 3]], SIGMA[[0, 2, 3]], rtol=0.4)  # a little more, as it lies far away
    np.testing.assert_allclose(found.rig, np.maximum(BIAS, PLACE), rtol=1e-6)


def test_a_faint_check_says_less_and_one_of_bad_data_nothing() -> None:
    clear, faint = (of_check("e", POSE, _observation(np.zeros(6), weak)) for weak in (False, True))
    assert clear is not None
    assert faint is not None
    np.testing.assert_allclose(clear.information, faint.information * WEAK_TIMES**2, rtol=1e-9)
    assert faint.log_bad > clear.log_bad
    cause = next(iter(CAUSES.values()))
    assert of_check("e", POSE, replace(_observation(TURN), causes=(cause,))) is None
    assert of_check("e", POSE, _observation(TURN), share=0.0) is None


def test_a_check_carries_since_when_its_pair_is_suspected_by_itself() -> None:
    for since_ns in (None, 5):
        found = of_check("e", POSE, _observation(TURN), stepped_ns=since_ns)
        assert found is not None
        assert found.stepped_ns == since_ns


@pytest.mark.fault(
    "a check of a rig's pair is NaN, or comes where no pose is served", "it counts for nothing, or is refused"
)
def test_hostile_checks_say_nothing() -> None:
    assert of_check("e", POSE, _observation(np.full(6, np.nan))) is None
    only_turns = of_check("e", POSE, _observation(np.array([0.01, 0.0, 0.0, np.nan, 0.0, 0.0])))
    assert only_turns is not None
    assert not only_turns.information[3:].any()
    with pytest.raises(ValueError, match="e: a pose must be a rigid transform"):
        of_check("e", np.full((4, 4), np.inf), _observation(TURN))


def test_a_window_of_rotations_tells_rotations_and_what_windows_share_counts() -> None:
    noise = np.diag([*SIGMA[:3] ** 2, np.nan, np.nan, np.nan])
    noise[3:, :] = noise[:, 3:] = np.nan
    window = Measurement(POSE, Uncertainty(noise, {"lens_down": SIGMA * np.eye(6)[0]}, 9.0), NS)
    found = of_window("e", window)
    assert found is not None
    assert not found.information[3:].any()
    assert found.information[0, 0] == pytest.approx(1.0 / (2.0 * SIGMA[0] ** 2 + (BIAS_TIMES * BIAS[0]) ** 2))
    assert of_window("e", replace(window, uncertainty=Uncertainty.unknown())) is None


def test_a_step_is_the_difference_of_two_robust_means() -> None:
    rng, history = np.random.default_rng(1), History.at(EDGE.T_a_b, BIAS)
    for turn in range(MOST_LOOKS):
        error = SIGMA * rng.normal(size=6) + (TURN if turn >= 16 else 0.0)
        if turn in (5, 18):
            error = np.array([radians(3.0), 0.0, radians(-2.0), 0.1, 0.0, 0.0])
        history = history.after(look(EDGE, POSES, float(turn), error), calm=True)
    steps = steps_at(history, [16 * NS, 20 * NS])
    away = steps.xi[0] - TURN
    assert float(away @ np.linalg.solve(steps.covariance[0], away)) < 22.5
    assert steps.looks[0] == pytest.approx(7.0, abs=0.3)  # of eight one is bad
    assert steps.log_stepped[0] > steps.log_stepped[1]  # it was then, and not later


def test_old_looks_are_counted_together_in_calm_and_forgotten_in_doubt() -> None:
    rng = np.random.default_rng(2)
    calm = doubt = History.at(EDGE.T_a_b, BIAS)
    for turn in range(3 * MOST_LOOKS):
        seen = look(EDGE, POSES, float(turn), PLACE + 0.1 * SIGMA * rng.normal(size=6))
        calm, doubt = calm.after(seen, calm=True), doubt.after(seen, calm=False)
    assert len(calm.looks) == len(doubt.looks) == MOST_LOOKS
    np.testing.assert_allclose(calm.mean, PLACE, rtol=0.15)
    np.testing.assert_array_equal(doubt.mean, 0.0)
