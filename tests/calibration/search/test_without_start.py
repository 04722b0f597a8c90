"""Without an initial guess: the true pose in any frame of the LiDAR, and no pose where none fits."""

from dataclasses import replace
from math import inf, pi

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.scan_axis import with_turned_clouds
from coec.calibration.search.without_start import calibrate_without_start, limit_for_more_poses, without_start
from coec.calibration.solver import log_prior
from coec.calibration.types import Decision, DepthModel, Estimate, Matrix4, Silence, Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.errors import UsageError
from coec.geometry import se3
from coec.io.images import GreyImages

UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Points with x right, y down, z forward."""


def turned(window: Window, rotation: NDArray[np.float64]) -> Window:
    """The window in another frame of the LiDAR."""
    return with_turned_clouds(window, se3.transform_from(rotation, np.zeros(3)))


def solved(window: Window, depth: DepthModel, dof: int = 3) -> Estimate:
    config = CalibrationConfig.model_validate({"search": {"dof": dof}})
    estimate, weighed = calibrate_without_start(
        without_start(window), depth, GreyImages(LimitsConfig()), config, Silence()
    )
    assert weighed.rotations > 100_000 > weighed.ascended >= weighed.ranked >= weighed.solved > 0
    return estimate


def error_deg(estimate: Estimate, truth: Matrix4) -> float:
    return float(np.degrees(se3.rotation_angle_rad(estimate.optimum.T_camera_lidar @ se3.inverse(truth))))


@pytest.mark.parametrize("every", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_the_pose_is_recovered_upside_down(street: Window, stereo: DepthModel, every: int) -> None:
    window = turned(replace(street, pairs=street.pairs[::every]), UPSIDE_DOWN)
    estimate = solved(window, stereo)
    assert error_deg(estimate, window.rig.T_camera_lidar_nominal) < 0.5
    assert np.degrees(np.linalg.norm(estimate.correction[:3])) < 0.5


@pytest.mark.slow
def test_with_six_degrees_of_freedom_only_the_clouds_and_images_are_known(street: Window, stereo: DepthModel) -> None:
    window = turned(street, OPTICAL)
    truth = window.rig.T_camera_lidar_nominal
    estimate = solved(replace(window, T_camera_lidar_start=np.eye(4)), stereo, dof=6)
    assert error_deg(estimate, truth) < 1.0
    assert np.linalg.norm(se3.difference(estimate.optimum.T_camera_lidar, truth)[3:]) < 0.2


@pytest.mark.parametrize("half", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_sweeps_of_other_frames_are_refused(street: Window, stereo: DepthModel, half: int) -> None:
    pairs = street.pairs[: 2 * half]
    mixed = tuple(
        replace(pair, camera=replace(other.camera, stamp_ns=pair.camera.stamp_ns))
        for pair, other in zip(pairs, (*pairs[half:], *pairs[:half]), strict=True)
    )
    estimate = solved(replace(street, pairs=mixed), stereo)
    assert estimate.verdict.decision is Decision.FAILED


def test_nothing_is_known_of_the_pose_before() -> None:
    away = se3.perturbation(np.array([0.0, pi, 0.0, 0.0, 0.0, 0.0]))
    assert log_prior(away, np.eye(4), inf) == 0.0


def test_more_poses_need_more_significance() -> None:
    limits = [limit_for_more_poses(6.0, more) for more in (1.0, 100.0, 10_000.0)]
    assert limits == sorted(limits)
    assert limits[0] == 6.0
    # As rare as before in all: a hundredth of the tail for each of a hundred times as many poses.
    assert np.exp(-0.5 * limits[1] ** 2) * 100.0 == pytest.approx(np.exp(-0.5 * 6.0**2))


def test_only_the_fused_objective_searches_without_a_start(street: Window, stereo: DepthModel) -> None:
    config = CalibrationConfig.model_validate({"objective": {"kind": "mi"}})
    with pytest.raises(UsageError, match="fused"):
        calibrate_without_start(street, stereo, GreyImages(LimitsConfig()), config, Silence())
