"""The objective itself: what is frozen, what is culled, what the guard does."""

import numpy as np
import pytest

from coec.calibration.objective.mutual_information import (
    GUARD_OVERLAP,
    MutualInformation,
    Points,
    SearchBox,
    build_mutual_information,
    distance_and_depth,
    distances,
)
from coec.calibration.types import DepthMap, DepthModel, Window
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


NEAR = SearchBox(np.radians(4.0), 0.1)


def points_of(window: Window, every: int) -> list[Points]:
    """Of each sweep one point of so many."""
    return [distances(pair.lidar.xyz_m[::every], window.T_camera_lidar_start) for pair in window.pairs]


def test_the_same_points_give_the_same_near_a_pose(objective: MutualInformation, street: Window) -> None:
    """All that no pose near by brings into view may be left out."""
    truth, rng = street.T_camera_lidar_start, np.random.default_rng(3)
    points = [
        Points(one.xyz_m[seen], one.of_points[seen])
        for one in points_of(street, 1)
        for seen in [objective.may_see(one.xyz_m, truth, NEAR)]
    ]
    assert sum(len(one.xyz_m) for one in points) < 0.8 * sum(len(pair.lidar.xyz_m) for pair in street.pairs)
    again = objective.with_points(points, np.ones(len(points)), truth, NEAR, ObjectiveConfig())
    for _ in range(5):
        pose = se3.perturb(truth, rng.uniform(-1.0, 1.0, 6) * [*[NEAR.rotation_rad] * 3, *[NEAR.translation_m] * 3])
        whole, near = objective.evaluate(pose), again.evaluate(pose)
        assert near.points_in_view == whole.points_in_view
        assert near.overlap == whole.overlap
        # Shares of distances are those of other points.
        assert near.mi == pytest.approx(whole.mi, rel=0.05)


def test_as_much_is_expected_in_view_as_there_are_points(objective: MutualInformation, street: Window) -> None:
    truth, every = street.T_camera_lidar_start, 3
    times = np.full(len(street.pairs), 1.0 / every)
    fewer = objective.with_points(points_of(street, every), times, truth, NEAR, ObjectiveConfig())
    assert fewer.evaluate(truth).points_in_view < 0.4 * objective.evaluate(truth).points_in_view
    assert fewer.evaluate(truth).overlap == pytest.approx(objective.evaluate(truth).overlap, rel=0.02)


def test_unrelated_depth_determines_less(objective: MutualInformation, street: Window) -> None:
    truth = objective.evaluate(street.T_camera_lidar_start)
    assert objective.mi_of_unrelated(street.T_camera_lidar_start) < truth.mi / 1.2


def test_distance_counts_from_the_camera_however_it_is_turned(street: Window) -> None:
    pose, xyz_m = street.T_camera_lidar_start, street.pairs[0].lidar.xyz_m
    turned = se3.perturb(pose, np.array([0.3, -0.2, 0.4, 0.0, 0.0, 0.0]))
    map_of_nothing = DepthMap(np.zeros((2, 2), np.float32))
    expected = np.linalg.norm(xyz_m @ pose[:3, :3].T + pose[:3, 3], axis=1)
    for T in (pose, turned):
        np.testing.assert_allclose(distance_and_depth(xyz_m, map_of_nothing, T).of_points, expected, rtol=1e-5)
