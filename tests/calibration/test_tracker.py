"""Windows combined into one extrinsic: noise is averaged away, a step is noticed at once and taken at the second."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import permutations
from math import degrees, radians, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.tracker import (
    NS_PER_H,
    Measurement,
    StepState,
    Track,
    chi_square_tail,
    fits,
    prior_sigma,
    update_track,
)
from coec.calibration.types import Uncertainty
from coec.config import TrackerConfig
from coec.geometry import se3
from coec.io.converter import MalformedValueError, structured
from coec.service.records.state_store import STATE_FORM

Array = NDArray[np.float64]

STILL = TrackerConfig(drift_deg_per_sqrt_h=0.0, drift_m_per_sqrt_h=0.0)
"""A mount that does not creep: the order of windows does not matter."""

SIGMA = np.array([radians(0.05), radians(0.04), radians(0.1), 0.03, 0.02, 0.05])
ROTATION_ONLY = np.where(np.arange(6) < 3, SIGMA, np.nan)
TRUTH = se3.perturb(
    np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.3], [1.0, 0.0, 0.0, -0.4], [0.0, 0.0, 0.0, 1.0]]),
    np.array([0.02, -0.03, 0.01, 0.0, 0.0, 0.0]),
)
PERIOD_NS = NS_PER_H // 20
"""A window every three minutes."""


def track_at(T_camera_lidar: Array) -> Track:
    return Track.initial(T_camera_lidar, prior_sigma(STILL))


def about(T_camera_lidar: Array, xi: Array, sigma: Array = SIGMA, stamp_ns: int = 0) -> Measurement:
    return Measurement(se3.perturb(T_camera_lidar, xi), Uncertainty.independent(sigma), stamp_ns)


def noise_alone(covariance: Array) -> Uncertainty:
    return Uncertainty(covariance, {}, np.nan)


def yaw(angle_deg: float) -> Array:
    return np.array([0.0, radians(angle_deg), 0.0, 0.0, 0.0, 0.0])


def samples(rng: np.random.Generator, count: int, sigma: Array = SIGMA) -> list[Measurement]:
    return [about(TRUTH, rng.normal(0.0, SIGMA), sigma, k * PERIOD_NS) for k in range(count)]


def after(track: Track, measurements: list[Measurement], config: TrackerConfig = STILL) -> Track:
    for measurement in measurements:
        track = update_track(track, measurement, config)
    return track


def error(track: Track) -> Array:
    return se3.difference(track.T_camera_lidar, TRUTH)


# -------------------------------------------------------------------------------------------------- the slow track
@pytest.mark.parametrize("count", [1, 4, 25])
def test_variance_falls_with_the_number_of_windows(count: int, rng: np.random.Generator) -> None:
    track = after(track_at(TRUTH), samples(rng, count))
    information = count / SIGMA**2 + 1.0 / prior_sigma(STILL) ** 2
    np.testing.assert_allclose(np.sqrt(track.covariance.diagonal()), 1.0 / np.sqrt(information), rtol=1e-3)
    assert track.windows == count


def test_the_mean_is_weighted_by_information() -> None:
    sharp, vague = about(TRUTH, yaw(0.1), 0.5 * SIGMA), about(TRUTH, yaw(-0.1), SIGMA)
    assert degrees(error(after(track_at(TRUTH), [sharp, vague]))[1]) == pytest.approx((4 * 0.1 - 0.1) / 5, abs=1e-4)


def test_a_window_that_counts_double_is_two_windows(rng: np.random.Generator) -> None:
    once = about(TRUTH, rng.normal(0.0, SIGMA))
    double = Measurement(once.T_camera_lidar, noise_alone(0.5 * once.uncertainty.noise), 0)
    twice, at_once = after(track_at(TRUTH), [once, once]), after(track_at(TRUTH), [double])
    np.testing.assert_allclose(twice.T_camera_lidar, at_once.T_camera_lidar, atol=1e-9)
    np.testing.assert_allclose(twice.covariance, at_once.covariance, rtol=1e-7, atol=1e-15)


def test_without_creep_the_order_does_not_matter(rng: np.random.Generator) -> None:
    windows = samples(rng, 4)
    tracks = [after(track_at(TRUTH), list(order)) for order in permutations(windows)]
    for track in tracks[1:]:
        assert np.abs(se3.difference(track.T_camera_lidar, tracks[0].T_camera_lidar)).max() < 0.01 * SIGMA.min()
        np.testing.assert_allclose(track.covariance, tracks[0].covariance, rtol=1e-9, atol=1e-18)


def test_moving_the_lidar_frame_moves_the_track_with_it(rng: np.random.Generator) -> None:
    """The perturbation is about the camera: another LiDAR frame on the right changes nothing else."""
    T_lidar_other = se3.exp(rng.normal(size=6))
    windows = samples(rng, 5)
    moved = [replace(w, T_camera_lidar=w.T_camera_lidar @ T_lidar_other) for w in windows]
    here, there = after(track_at(TRUTH), windows), after(track_at(TRUTH @ T_lidar_other), moved)
    np.testing.assert_allclose(here.T_camera_lidar @ T_lidar_other, there.T_camera_lidar, atol=1e-9)
    np.testing.assert_allclose(here.covariance, there.covariance, rtol=1e-9, atol=1e-18)


def test_axes_that_no_window_determines_keep_their_prior(rng: np.random.Generator) -> None:
    start = se3.perturb(TRUTH, np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0]))
    windows = [about(TRUTH, np.where(np.arange(6) < 3, rng.normal(0.0, SIGMA), 9.0), ROTATION_ONLY) for _ in range(6)]
    track = after(track_at(start), windows)
    moved = se3.difference(track.T_camera_lidar, start)
    np.testing.assert_allclose(moved[3:], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(track.covariance.diagonal())[3:], prior_sigma(STILL)[3:])
    assert track.observed.tolist() == [True] * 3 + [False] * 3
    assert np.abs(error(track)[:3]).max() < 3 * SIGMA.max()


def test_correlated_axes_inform_each_other() -> None:
    """Pitch and height move together: a window that tells the height alone tells the pitch, too."""
    covariance = np.diag(SIGMA**2)
    covariance[0, 4] = covariance[4, 0] = 0.9 * SIGMA[0] * SIGMA[4]
    track = after(track_at(TRUTH), [Measurement(TRUTH, noise_alone(covariance), 0)])
    height_only = np.where(np.arange(6) == 4, 1e-4, np.nan)
    reported = after(track, [about(TRUTH, np.array([0.0, 0.0, 0.0, 0.0, 0.01, 0.0]), height_only)])
    assert error(reported)[0] == pytest.approx(0.9 * SIGMA[0] / SIGMA[4] * 0.01, rel=0.05)
    assert sqrt(reported.covariance[0, 0]) == pytest.approx(sqrt(1.0 - 0.81) * SIGMA[0], rel=0.05)


def test_a_window_that_is_uninformative_changes_nothing() -> None:
    track = track_at(TRUTH)
    assert update_track(track, about(TRUTH, yaw(1.0), np.full(6, np.nan)), STILL) is track


def test_a_mount_that_creeps_is_followed(rng: np.random.Generator) -> None:
    """A fifth of a degree in twenty hours, a window every three minutes."""
    config = TrackerConfig()
    track = Track.initial(TRUTH, prior_sigma(config))
    hours = 20
    for k in range(hours * 20):
        crept = yaw(0.2 * k / (hours * 20))
        track = update_track(track, about(TRUTH, crept + rng.normal(0.0, SIGMA), SIGMA, k * PERIOD_NS), config)
        assert track.step is StepState.NONE
    assert degrees(error(track)[1]) == pytest.approx(0.2, abs=0.03)


SHARED = {"lens": yaw(0.05), "stamps": np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.01])}
"""What every window of a rig has in common: a shift by one standard deviation, by the name of its cause."""


def sharing(measurement: Measurement, systematic: dict[str, Array] = SHARED) -> Measurement:
    return replace(measurement, uncertainty=replace(measurement.uncertainty, systematic=systematic))


def test_noise_averages_away_and_what_windows_have_in_common_does_not(rng: np.random.Generator) -> None:
    alone = after(track_at(TRUTH), samples(rng, 200))
    track = after(track_at(TRUTH), [sharing(window) for window in samples(rng, 200)])
    np.testing.assert_allclose(track.covariance, alone.covariance, rtol=1e-9)
    assert np.sqrt(track.covariance.diagonal())[1] < 0.1 * SIGMA[1]
    expected = np.sqrt(track.covariance.diagonal() + SHARED["lens"] ** 2 + SHARED["stamps"] ** 2)
    np.testing.assert_allclose(track.uncertainty.sigma, expected, rtol=1e-3)


def test_the_same_cause_in_opposite_directions_cancels() -> None:
    """A scene to the left and one to the right: what pulls the pose either way is one error, not two."""
    there, back = ({"edges": sign * yaw(0.05)} for sign in (1.0, -1.0))
    track = after(track_at(TRUTH), [sharing(about(TRUTH, yaw(0.0)), there), sharing(about(TRUTH, yaw(0.0)), back)])
    assert np.abs(track.uncertainty.systematic["edges"]).max() < 0.01 * radians(0.05)


def test_a_scene_that_pulls_elsewhere_is_no_step(rng: np.random.Generator) -> None:
    """Another scene, another tenth of a degree: within what windows of one scene share, that is not a bent mount."""
    window = about(TRUTH, yaw(0.3))
    track = after(track_at(TRUTH), samples(rng, 200))
    assert update_track(track, window, STILL).step is StepState.SUSPECTED
    assert update_track(track, sharing(window, {"edges": yaw(0.1)}), STILL).step is StepState.NONE


def test_three_sigma_covers() -> None:
    """Honest windows: the track's own three sigma hold in at least 99 of 100 runs per axis."""
    rng = np.random.default_rng(11)
    covered = np.zeros(6)
    for _ in range(300):
        track = after(track_at(TRUTH), samples(rng, 8))
        covered += np.abs(error(track)) <= 3.0 * track.uncertainty.sigma
    assert (covered >= 0.99 * 300).all()


# -------------------------------------------------------------------------------------------------- the fast track
def test_a_step_is_noticed_by_the_first_window_and_taken_at_the_second(rng: np.random.Generator) -> None:
    track = after(track_at(TRUTH), samples(rng, 20))
    before = track.T_camera_lidar
    first, second = (about(TRUTH, yaw(1.0) + rng.normal(0.0, SIGMA)) for _ in range(2))
    track = update_track(track, first, STILL)
    assert track.step is StepState.SUSPECTED
    assert track.candidate is not None
    assert track.chance < STILL.step_false_alarm
    np.testing.assert_array_equal(track.T_camera_lidar, before)
    track = update_track(track, second, STILL)
    assert track.step is StepState.CONFIRMED
    assert track.candidate is None
    assert track.windows == 2
    assert degrees(error(track)[1]) == pytest.approx(1.0, abs=3 * 0.04 / sqrt(2))
    assert update_track(track, second, STILL).step is StepState.NONE


@pytest.mark.fault("a single wrong window", "what is served does not move")
def test_one_outlier_does_not_move_the_track(rng: np.random.Generator) -> None:
    windows = samples(rng, 12)
    outlier = about(TRUTH, np.array([0.3, -0.2, 0.1, 0.4, 0.0, 0.0]), SIGMA, 5 * PERIOD_NS)
    clean, hit = after(track_at(TRUTH), windows), after(track_at(TRUTH), [*windows[:6], outlier, *windows[6:]])
    np.testing.assert_array_equal(hit.T_camera_lidar, clean.T_camera_lidar)
    assert hit.step is StepState.NONE
    assert hit.candidate is None


def test_two_outliers_that_disagree_confirm_nothing(rng: np.random.Generator) -> None:
    track = after(track_at(TRUTH), samples(rng, 6))
    wrong = after(track, [about(TRUTH, yaw(2.0)), about(TRUTH, yaw(-2.0))])
    assert wrong.step is StepState.SUSPECTED
    np.testing.assert_array_equal(wrong.T_camera_lidar, track.T_camera_lidar)


def test_after_a_step_of_the_rotation_the_translation_is_as_uncertain_as_at_first(rng: np.random.Generator) -> None:
    track = after(track_at(TRUTH), samples(rng, 10))
    bent = after(track, [about(TRUTH, yaw(3.0), ROTATION_ONLY)] * 2)
    assert bent.step is StepState.CONFIRMED
    np.testing.assert_allclose(np.sqrt(bent.covariance.diagonal())[3:], prior_sigma(STILL)[3:])
    assert bent.observed.tolist() == [True] * 3 + [False] * 3


def test_an_overwhelming_window_is_taken_alone_only_where_that_is_allowed(rng: np.random.Generator) -> None:
    bold = STILL.model_copy(update={"overwhelming_false_alarm": 1e-30})
    track = after(track_at(TRUTH), samples(rng, 10))
    window = about(TRUTH, yaw(5.0))
    assert update_track(track, window, STILL).step is StepState.SUSPECTED
    taken = update_track(track, window, bold)
    assert taken.step is StepState.CONFIRMED
    np.testing.assert_allclose(taken.T_camera_lidar, window.T_camera_lidar, atol=1e-12)


def test_false_alarms_are_as_rare_as_requested() -> None:
    """The distance is chi-square distributed: at a limit of a hundredth, a hundredth."""
    config = STILL.model_copy(update={"step_false_alarm": 0.01})
    rng = np.random.default_rng(5)
    track = after(track_at(TRUTH), samples(rng, 20), config)
    alarms = sum(update_track(track, w, config).step is StepState.SUSPECTED for w in samples(rng, 3000))
    assert alarms == pytest.approx(30, abs=4 * sqrt(30))


# -------------------------------------------------------------------------------------------------------- the rest
@pytest.mark.parametrize("degrees_of_freedom", range(1, 7))
def test_chi_square_tail_is_the_integral_of_its_density(degrees_of_freedom: int) -> None:
    # In s = √x the density s^(k-1)·exp(-s²/2) has no pole at zero.
    s = np.linspace(0.0, 12.0, 240_001)
    density = s ** (degrees_of_freedom - 1) * np.exp(-(s**2) / 2.0)
    steps = 0.5 * (density[1:] + density[:-1])
    for at in (0.5, 1.0, 2.5, 4.0):
        expected = steps[s[:-1] >= at - 1e-9].sum() / steps.sum()
        assert chi_square_tail(at**2, degrees_of_freedom) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("x", "k"), [(3.841459, 1), (7.814728, 3), (12.591587, 6)])
def test_chi_square_tail_at_five_percent(x: float, k: int) -> None:
    assert chi_square_tail(x, k) == pytest.approx(0.05, rel=1e-5)
    assert chi_square_tail(0.0, k) == 1.0
    assert chi_square_tail(1e6, k) == 0.0


def test_a_restart_gives_the_same_bytes(rng: np.random.Generator) -> None:
    windows = [*samples(rng, 5), about(TRUTH, yaw(1.0)), about(TRUTH, yaw(1.01)), *samples(rng, 2)]
    config = TrackerConfig()
    through = track_at(TRUTH)
    restarted = through
    for window in windows:
        through = update_track(through, window, config)
        document = json.loads(json.dumps(STATE_FORM.unstructure(restarted)))
        restarted = update_track(structured(STATE_FORM, document, Track), window, config)
    assert json.dumps(STATE_FORM.unstructure(through)) == json.dumps(STATE_FORM.unstructure(restarted))
    assert through.T_camera_lidar.tobytes() == restarted.T_camera_lidar.tobytes()


def test_a_track_of_an_older_version_has_no_lag(rng: np.random.Generator) -> None:
    track = after(track_at(TRUTH), samples(rng, 5), TrackerConfig())
    document = json.loads(json.dumps(STATE_FORM.unstructure(track)))
    assert any(document.pop("lag"))
    read = structured(STATE_FORM, document, Track)
    assert not read.lag.any()
    assert read.T_camera_lidar.tobytes() == track.T_camera_lidar.tobytes()


@pytest.mark.parametrize("broken", ["slow", "stamp_ns", "step", "prior_sigma"])
def test_a_broken_document_is_refused(broken: str) -> None:
    document = STATE_FORM.unstructure(track_at(TRUTH))
    for value in (None, "x", [[1.0]]):
        with pytest.raises(MalformedValueError, match=broken):
            structured(STATE_FORM, {**document, broken: value}, Track)
    del document[broken]
    with pytest.raises(MalformedValueError, match=f"{broken} is missing"):
        structured(STATE_FORM, document, Track)


@pytest.mark.parametrize(
    ("pose", "sigma"), [(2.0 * TRUTH, SIGMA), (TRUTH, np.zeros(6)), (TRUTH, ROTATION_ONLY), (TRUTH, SIGMA[:3])]
)
def test_a_track_starts_at_a_rigid_pose_with_a_spread(pose: Array, sigma: Array) -> None:
    with pytest.raises(ValueError, match="of a track must be"):
        Track.initial(pose, sigma)


# ------------------------------------------------------------------------------------------------------- a drift
def in_scenes(rng: np.random.Generator, count: int, rate_deg: float) -> list[tuple[Array, Measurement]]:
    """Truths and windows of a mount that drifts by so much from one window to the next. The scene, another one every
    five windows, shifts all three axes by some hundredths of a degree."""
    made = []
    for k in range(count):
        if k % 5 == 0:
            scene = rng.normal(0.0, radians(0.04), 3)
        truth = se3.perturb(TRUTH, k * yaw(rate_deg))
        shift = np.append(scene + rng.normal(0.0, radians(0.03), 3), np.zeros(3))
        noise = np.diag([radians(0.03) ** 2] * 3 + [np.nan] * 3)
        systematic = {f"scene_{axis}": radians(0.09) * np.eye(6)[axis] for axis in range(3)}
        window = Measurement(se3.perturb(truth, shift), Uncertainty(noise, systematic, np.nan), k * PERIOD_NS)
        made.append((truth, window))
    return made


def test_a_drift_leaves_what_is_known_of_axes_that_no_window_determines(rng: np.random.Generator) -> None:
    windows = [window for _, window in in_scenes(rng, 60, 0.05)]
    still = after(track_at(TRUTH), windows[:1])
    drifting = after(track_at(TRUTH), windows)
    assert drifting.windows == 60, "it never was a step"
    np.testing.assert_allclose(drifting.covariance[3:, 3:], still.covariance[3:, 3:], rtol=1e-9)


def test_an_outlier_does_not_hide_a_lag(rng: np.random.Generator) -> None:
    windows = [window for _, window in in_scenes(rng, 20, 0.01)]
    before = after(track_at(TRUTH), windows[:-1], TrackerConfig())
    outlier = replace(windows[-1], T_camera_lidar=se3.perturb(TRUTH, yaw(5.0)))
    suspected = update_track(before, outlier, TrackerConfig())
    assert suspected.step is StepState.SUSPECTED
    np.testing.assert_array_equal(suspected.lag, before.lag)


def off_deg(rng: np.random.Generator, rate_deg: float) -> list[float]:
    track, off = track_at(TRUTH), []
    for truth, window in in_scenes(rng, 60, rate_deg):
        track = update_track(track, window, TrackerConfig())
        off.append(degrees(se3.rotation_angle_rad(track.T_camera_lidar @ se3.inverse(truth))))
    return off


@pytest.mark.parametrize(("rate_deg", "at_most_deg"), [(0.027, 0.3), (0.05, 0.3), (0.15, 0.6)])
def test_a_drift_is_followed_even_if_no_window_by_itself_is_improbable(
    rng: np.random.Generator, rate_deg: float, at_most_deg: float
) -> None:
    assert max(max(off_deg(rng, rate_deg)[1:]) for _ in range(10)) <= at_most_deg


def test_scenes_that_shift_windows_as_little_as_they_say_are_averaged(rng: np.random.Generator) -> None:
    assert np.sqrt(np.mean(np.square([off_deg(rng, 0.0)[20:] for _ in range(10)]))) <= 0.04


def test_a_window_that_is_improbable_counts_for_more_while_the_monitor_doubts() -> None:
    settled = after(track_at(TRUTH), [about(TRUTH, np.zeros(6), SIGMA, k * PERIOD_NS) for k in range(5)])
    offset = about(TRUTH, yaw(0.18), SIGMA, 5 * PERIOD_NS)
    assert update_track(settled, offset, STILL).step is StepState.NONE
    calm, doubted = (
        degrees(error(update_track(settled, offset, STILL, doubted=doubted))[1]) for doubted in (False, True)
    )
    assert calm < 0.04
    assert 0.09 < doubted < 0.18


def test_a_doubt_changes_nothing_about_a_window_that_is_probable() -> None:
    settled = after(track_at(TRUTH), [about(TRUTH, np.zeros(6), SIGMA, k * PERIOD_NS) for k in range(5)])
    near = about(TRUTH, yaw(0.03), SIGMA, 5 * PERIOD_NS)
    one, other = (update_track(settled, near, STILL, doubted=doubted) for doubted in (False, True))
    np.testing.assert_array_equal(one.T_camera_lidar, other.T_camera_lidar)


def test_a_window_vouches_for_what_it_finds_probable() -> None:
    window = about(TRUTH, yaw(0.0))
    assert fits(TRUTH, window)
    assert fits(se3.perturb(TRUTH, yaw(0.08)), window)
    assert not fits(se3.perturb(TRUTH, yaw(0.2)), window)
    blind = about(TRUTH, yaw(0.0), np.full(6, np.nan))
    assert fits(se3.perturb(TRUTH, yaw(3.0)), blind), "it determines no axis"
