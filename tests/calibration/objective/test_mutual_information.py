"""The objective itself: what is frozen, what is culled, what the guard does."""

import numpy as np
import pytest

from coec.calibration.objective.mutual_information import (
    GUARD_OVERLAP,
    MutualInformation,
    SearchBox,
    build_mutual_information,
    distance_and_depth,
)
from coec.calibration.ports import DepthModel
from coec.calibration.types import DepthMap, Window
from coec.config import ObjectiveConfig
from coec.geometry import se3


def objective_of(window: Window, depth: DepthModel, box: SearchBox) -> MutualInformation:
    return build_mutual_information(
        [
            distance_and_depth(pair.lidar.xyz_m, depth.infer(pair.camera), window.T_camera_lidar_start)
            for pair in window.pairs
        ],
        window.rig,
        window.T_camera_lidar_start,
        box,
        ObjectiveConfig(),
    )


@pytest.fixture(scope="module")
def objective(street: Window, stereo: DepthModel) -> MutualInformation:
    return objective_of(street, stereo, SearchBox(np.radians(10.0), 0.0))


def test_points_that_no_pose_of_the_box_can_see_are_all_that_is_left_out(street: Window, stereo: DepthModel) -> None:
    """A box of half a turn keeps every point; a small one must not lose any that its own poses see."""
    rng = np.random.default_rng(5)
    box = SearchBox(np.radians(6.0), 0.2)
    culled = objective_of(street, stereo, box)
    full = objective_of(street, stereo, SearchBox(np.pi, 10.0))
    for _ in range(20):
        xi = rng.uniform(-1, 1, 6) * [*[box.rotation_rad] * 3, *[box.translation_m] * 3]
        pose = se3.perturb(street.T_camera_lidar_start, xi)
        assert culled.evaluate(pose).points_in_view == full.evaluate(pose).points_in_view


def test_the_score_is_mutual_information_while_enough_is_in_view(objective: MutualInformation, street: Window) -> None:
    at_truth = objective.evaluate(street.T_camera_lidar_start)
    assert at_truth.overlap > GUARD_OVERLAP
    assert at_truth.score == pytest.approx(at_truth.mi)
    assert at_truth.frame_scores.mean() == pytest.approx(at_truth.score)


def test_looking_away_does_not_pay(objective: MutualInformation, street: Window) -> None:
    """Points leave the view when the camera looks up; the guarded score must not rise for it."""
    truth = objective.evaluate(street.T_camera_lidar_start)
    for pitch_deg in (40, 60, 80, 100, 120):
        xi = np.array([np.radians(pitch_deg), 0, 0, 0, 0, 0])
        away = objective.evaluate(se3.perturb(street.T_camera_lidar_start, xi))
        assert away.score < 0.7 * truth.score
        assert away.score <= away.mi


def test_the_truth_is_a_maximum_along_every_rotation(objective: MutualInformation, street: Window) -> None:
    truth = objective.evaluate(street.T_camera_lidar_start).score
    for axis in range(3):
        for degrees in (-6, -3, -1, 1, 3, 6):
            xi = np.zeros(6)
            xi[axis] = np.radians(degrees)
            assert objective.evaluate(se3.perturb(street.T_camera_lidar_start, xi)).score < truth


def test_unrelated_depth_tells_less(objective: MutualInformation, street: Window) -> None:
    truth = objective.evaluate(street.T_camera_lidar_start)
    assert objective.mi_of_unrelated(street.T_camera_lidar_start) < truth.mi / 1.2


def test_distance_counts_from_the_camera_however_it_is_turned(street: Window) -> None:
    pose, xyz_m = street.T_camera_lidar_start, street.pairs[0].lidar.xyz_m
    turned = se3.perturb(pose, np.array([0.3, -0.2, 0.4, 0.0, 0.0, 0.0]))
    map_of_nothing = DepthMap(np.zeros((2, 2), np.float32))
    expected = np.linalg.norm(xyz_m @ pose[:3, :3].T + pose[:3, 3], axis=1)
    for T in (pose, turned):
        np.testing.assert_allclose(distance_and_depth(xyz_m, map_of_nothing, T).of_points, expected, rtol=1e-5)
