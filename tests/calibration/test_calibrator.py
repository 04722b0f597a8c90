"""The solver on a street with a known truth, and what must follow when its input is changed in a known way."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.pipeline import calibrate
from coec.calibration.types import CameraFrame, Decision, DepthMap, DepthModel, Estimate, Silence, StopReason, Window
from coec.config import CalibrationConfig, LimitsConfig, ObjectiveConfig, SearchConfig
from coec.errors import CalibrationError, DecodeError
from coec.geometry import se3
from coec.io.images import GreyImages

MI = ObjectiveConfig(kind="mi")
CONFIG = CalibrationConfig(objective=MI)
SIX = CalibrationConfig(objective=MI, search=SearchConfig(dof=6))
GREY = GreyImages(LimitsConfig())


def solve(window: Window, depth: DepthModel, config: CalibrationConfig = CONFIG) -> Estimate:
    return calibrate(window, depth, GREY, config, Silence())


def from_start(window: Window, *deg_and_m: float) -> Window:
    xi = np.zeros(6)
    xi[: len(deg_and_m)] = deg_and_m
    xi[:3] = np.radians(xi[:3])
    return replace(window, T_camera_lidar_start=se3.perturb(window.rig.T_camera_lidar_nominal, xi))


def error_deg(estimate: Estimate) -> NDArray[np.float64]:
    """Per axis; the nominal calibration of the street is the truth."""
    return np.degrees(estimate.correction[:3])


@pytest.mark.parametrize(
    "start",
    [
        (3, -3, 3),
        (0, 5, 0),
        *(pytest.param(start, marks=pytest.mark.slow) for start in ((5, 0, 0), (0, 0, 5), (-4, 4, 2))),
    ],
)
def test_starts_around_the_truth_come_back_to_it(street: Window, stereo: DepthModel, start: tuple[float, ...]) -> None:
    estimate = solve(from_start(street, *start), stereo)
    assert np.abs(error_deg(estimate)).max() < 0.3
    assert estimate.verdict.decision is Decision.ACCEPTED
    assert estimate.optimum.score > estimate.optimum.score_at_start


def test_six_degrees_of_freedom(street: Window, stereo: DepthModel) -> None:
    estimate = solve(from_start(street, 1, -1, 1, 0.1, -0.1, 0.1), stereo, SIX)
    assert np.abs(error_deg(estimate)).max() < 0.5
    # A street of walls along the way says little about the position along it.
    assert np.abs(estimate.correction[3:]).max() < 0.2
    assert estimate.solved.all()


def test_a_single_frame_gives_a_rotation(sharp_street: Window, stereo: DepthModel) -> None:
    """Where shifts are searched, too, what all frames have in common has to fit by itself."""
    one = replace(sharp_street, pairs=sharp_street.pairs[4:5])
    estimate = solve(from_start(one, 6, -5, 4), stereo, CalibrationConfig())
    assert estimate.verdict.decision is Decision.ACCEPTED
    assert np.abs(error_deg(estimate)).max() < 4.0 * np.degrees(estimate.sigma[:3]).max() < 1.2
    of_shifts = {"edges_once", "range_significance"}
    assert not of_shifts & {metric.name for metric in estimate.verdict.metrics}
    with_shifts = solve(one, stereo, CalibrationConfig(search=SearchConfig(dof=6)))
    assert of_shifts <= {metric.name for metric in with_shifts.verdict.metrics}


@pytest.mark.fault("another frame's sweep with a single image", "the result is not believed")
def test_a_single_image_with_the_sweep_of_another_place_is_not_believed(
    sharp_street: Window, stereo: DepthModel
) -> None:
    image, sweep = sharp_street.pairs[1], sharp_street.pairs[-2]
    mixed = replace(sharp_street, pairs=(replace(image, lidar=replace(sweep.lidar, stamp_ns=image.lidar.stamp_ns)),))
    assert solve(mixed, stereo, CalibrationConfig()).verdict.decision is Decision.FAILED


def test_same_input_same_bits(street: Window, stereo: DepthModel) -> None:
    first, second = (solve(from_start(street, 3, -3, 3), stereo) for _ in range(2))
    assert first.optimum.T_camera_lidar.tobytes() == second.optimum.T_camera_lidar.tobytes()
    assert first.sigma.tobytes() == second.sigma.tobytes()
    assert first.verdict == second.verdict
    assert first.config_hash == second.config_hash


def test_turning_the_lidar_turns_the_optimum_back(street: Window, stereo: DepthModel) -> None:
    """Metamorphic: clouds turned by S about the LiDAR have their optimum at T·S⁻¹."""
    turn = se3.perturbation(np.array([0.0, 0.0, np.radians(30.0), 0.0, 0.0, 0.0]))
    off = CalibrationConfig(objective=MI, motion_compensation=False)
    start = from_start(street, 2, 1, -1)
    turned = replace(
        start,
        T_camera_lidar_start=start.T_camera_lidar_start @ se3.inverse(turn),
        pairs=tuple(
            replace(
                pair,
                lidar=replace(pair.lidar, xyz_m=(pair.lidar.xyz_m @ turn[:3, :3].T).astype(np.float32)),
            )
            for pair in start.pairs
        ),
    )
    plain, moved = solve(start, stereo, off), solve(turned, stereo, off)
    back = moved.optimum.T_camera_lidar @ turn
    assert np.degrees(se3.rotation_angle_rad(back @ se3.inverse(plain.optimum.T_camera_lidar))) < 0.05
    assert moved.optimum.score == pytest.approx(plain.optimum.score, abs=2e-3)


def test_the_order_of_the_frames_does_not_matter(street: Window, stereo: DepthModel) -> None:
    start = from_start(street, 2, 1, -1)
    backwards = replace(start, pairs=start.pairs[::-1])
    difference = solve(start, stereo).correction - solve(backwards, stereo).correction
    assert np.degrees(np.abs(difference[:3])).max() < 1e-6


class Recoded:
    """The same maps in another monotonic code."""

    identity = "recoded"

    def __init__(self, maps: DepthModel) -> None:
        self._maps = maps

    def infer(self, frame: CameraFrame) -> DepthMap:
        values = self._maps.infer(frame).values
        return DepthMap((np.exp(values / np.nanmax(values) * 3.0) - 7.0).astype(np.float32))


def test_any_monotonic_code_of_depth_gives_the_same_answer(street: Window, stereo: DepthModel) -> None:
    start = from_start(street, 2, 1, -1)
    difference = solve(start, stereo).correction - solve(start, Recoded(stereo)).correction
    assert np.degrees(np.abs(difference[:3])).max() < 0.05


class Shuffled:
    """Depth that belongs to other frames: what a frozen camera or a wrong pairing looks like."""

    identity = "shuffled"

    def __init__(self, maps: DepthModel, window: Window) -> None:
        frames = [pair.camera for pair in window.pairs]
        half = len(frames) // 2
        self._maps = maps
        self._other = {f.stamp_ns: frames[(i + half) % len(frames)] for i, f in enumerate(frames)}

    def infer(self, frame: CameraFrame) -> DepthMap:
        return self._maps.infer(self._other[frame.stamp_ns])


@pytest.mark.fault("depth maps of other frames", "the result is not believed")
def test_depth_of_other_frames_is_not_believed(street: Window, stereo: DepthModel) -> None:
    verdict = solve(street, Shuffled(stereo, street)).verdict
    assert verdict.decision is Decision.FAILED
    assert "mi_over_unrelated" in {reason.code for reason in verdict.reasons}


def test_a_truth_beyond_the_box_is_not_believed(street: Window, stereo: DepthModel) -> None:
    config = CalibrationConfig(objective=MI, search=SearchConfig(rotation_deg=2.0))
    estimate = solve(from_start(street, 0, 6, 0), stereo, config)
    assert estimate.optimum.stop_reason is StopReason.AT_BOUND
    assert estimate.verdict.decision is Decision.FAILED


class Flat:
    """A network that sees nothing."""

    identity = "flat"

    def infer(self, frame: CameraFrame) -> DepthMap:
        assert frame.image.data
        return DepthMap(np.ones((32, 32), np.float32))


def test_a_flat_depth_map_fails_with_its_reason(street: Window) -> None:
    verdict = solve(street, Flat()).verdict
    assert verdict.decision is Decision.FAILED
    assert "mi_over_unrelated" in {reason.code for reason in verdict.reasons}


def test_sigma_covers_the_error(street: Window, stereo: DepthModel) -> None:
    estimate = solve(from_start(street, 2, -2, 2), stereo)
    assert (np.abs(estimate.correction[:3]) < 5.0 * estimate.sigma[:3]).all()
    assert (np.degrees(estimate.sigma[:3]) < 0.5).all()
    assert np.isnan(estimate.sigma[3:]).all()


def test_a_window_without_pairs_is_an_error(street: Window, stereo: DepthModel) -> None:
    with pytest.raises(CalibrationError, match="holds no pairs"):
        solve(replace(street, pairs=()), stereo)


def test_a_window_without_a_point_in_the_range_limits_is_an_error(street: Window, stereo: DepthModel) -> None:
    config = CalibrationConfig(objective=ObjectiveConfig(kind="mi", min_range_m=150.0, max_range_m=151.0))
    with pytest.raises(CalibrationError, match="no LiDAR point"):
        solve(street, stereo, config)


def test_a_frame_without_depth_is_an_error_that_names_it(street: Window, stereo: DepthModel) -> None:
    pairs = (replace(street.pairs[0], camera=replace(street.pairs[0].camera, depth=None)), *street.pairs[1:])
    with pytest.raises(CalibrationError, match=str(street.pairs[0].stamp_ns)) as raised:
        solve(replace(street, pairs=pairs), stereo)
    assert isinstance(raised.value.__cause__, DecodeError)


def test_masked_pixels_do_not_count(street: Window, stereo: DepthModel) -> None:
    camera = street.rig.camera
    mask = np.ones((camera.height, camera.width), np.bool_)
    mask[camera.height // 2 :] = False
    masked = replace(street, rig=replace(street.rig, mask=mask))
    assert 0 < solve(masked, stereo).optimum.points_in_view < 0.7 * solve(street, stereo).optimum.points_in_view


def test_progress_is_reported(street: Window, stereo: DepthModel) -> None:
    class Listener:
        def __init__(self) -> None:
            self.steps: dict[str, int] = {}

        def step(self, stage: str, done: int, total: int) -> None:
            assert 0 < done <= total
            self.steps[stage] = done

    listener = Listener()
    estimate = calibrate(street, stereo, GREY, CONFIG, listener)
    assert listener.steps["depth"] == len(street.pairs)
    assert listener.steps["search"] == estimate.optimum.evaluations


def displaced(window: Window, first_late: int, turn_deg: float) -> Window:
    """The window as if the mount had turned in pitch before the pair `first_late`: its sweeps are turned back."""
    T_before = window.rig.T_camera_lidar_nominal
    T_after = se3.perturb(T_before, np.radians([turn_deg, 0.0, 0.0, 0.0, 0.0, 0.0]))
    back = (se3.inverse(T_after) @ T_before).astype(np.float32)
    late = tuple(
        replace(pair, lidar=replace(pair.lidar, xyz_m=pair.lidar.xyz_m @ back[:3, :3].T + back[:3, 3]))
        for pair in window.pairs[first_late:]
    )
    return replace(window, pairs=(*window.pairs[:first_late], *late))


def sparse(window: Window, knock: int) -> Window:
    """The window of every other pair, those it leaves out lying between, as if the mount had turned before the pair
    `knock`."""
    pairs = displaced(window, knock, 2.0).pairs
    return replace(window, pairs=pairs[::2], between=pairs[1::2])


@pytest.mark.fault(
    "a knock between two pairs of a window that lie far apart", "thinned pairs between the two date the knock"
)
def test_pairs_between_those_of_the_window_report_when_the_displacement_was(
    sharp_street: Window, stereo: DepthModel, record_property: Callable[[str, object], None]
) -> None:
    stamps_ns = [pair.stamp_ns for pair in sharp_street.pairs]
    window = sparse(sharp_street, 5)
    moved = solve(window, stereo, CalibrationConfig()).moved
    assert moved is not None
    assert (moved.last_before_ns, moved.first_after_ns) == (stamps_ns[4], stamps_ns[5])
    assert moved.pairs_after == 2, "pairs between are not kept for the next window"
    reported_s, separation_s = (moved.first_after_ns - moved.last_before_ns) / 1e9, (stamps_ns[6] - stamps_ns[4]) / 1e9
    record_property("figure", f"{reported_s:.0f} s of {separation_s:.0f} s")


@pytest.mark.fault("a picture between those of a window cannot be decoded", "it is passed over")
def test_a_pair_between_that_cannot_be_decoded_is_passed_over(
    sharp_street: Window, stereo: DepthModel, record_property: Callable[[str, object], None]
) -> None:
    window = sparse(sharp_street, 6)
    broken = replace(window.between[2].camera, image=replace(window.between[2].camera.image, data=b"no image"))
    between = (*window.between[:2], replace(window.between[2], camera=broken), *window.between[3:])
    moved = solve(replace(window, between=between), stereo, CalibrationConfig()).moved
    assert moved is not None
    stamps_ns = [pair.stamp_ns for pair in sharp_street.pairs]
    assert (moved.last_before_ns, moved.first_after_ns) == (stamps_ns[4], stamps_ns[6])
    record_property("figure", "the interval of the two pairs beside it")


@pytest.mark.fault("a knock in the middle of a window", "the window is refused, and says when it was")
def test_a_window_that_holds_a_knock_is_refused_and_says_when_it_was(sharp_street: Window, stereo: DepthModel) -> None:
    estimate = solve(displaced(sharp_street, 7, 2.0), stereo, CalibrationConfig())
    assert estimate.verdict.decision is Decision.FAILED
    (reason,) = (reason for reason in estimate.verdict.reasons if reason.code == "moved_within_window")
    assert "between 42.0 and 49.0 s after its first pair" in reason.text
    moved, pairs = estimate.moved, sharp_street.pairs
    assert moved is not None
    assert (moved.last_before_ns, moved.first_after_ns) == (pairs[6].stamp_ns, pairs[7].stamp_ns)
    turn = np.degrees(se3.difference(moved.T_after, moved.T_before)[:3])
    np.testing.assert_allclose(turn, [2.0, 0.0, 0.0], atol=0.4)
