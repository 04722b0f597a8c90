"""A translation that a window does not tell leaves the camera where it was: its centre, not the column t of
T_camera_lidar, which swings with every rotation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.objective.landscape import Curvature
from coec.calibration.objective.mutual_information import Evaluation
from coec.calibration.pipeline import calibrate
from coec.calibration.search.local_search import FixedCentre, SearchResult, unobservable, without
from coec.calibration.types import DepthModel, Estimate, Matrix4, Silence, StopReason, Window
from coec.config import CalibrationConfig, LimitsConfig, SearchConfig, VerdictConfig
from coec.geometry import se3
from coec.io.images import GreyImages

Turned = Callable[[Matrix4, Sequence[float]], Matrix4]

LEVER_ARM = se3.perturbation(np.array([1.2, -1.2, 1.2, 0.6, -0.6, -0.6]))
"""A camera 1.04 m from the LiDAR."""

SIX = SearchConfig(dof=6)
LIMITS = VerdictConfig()


def turned_about_camera(pose: Matrix4, turn: Sequence[float]) -> Matrix4:
    """The camera turns about its centre, by a rotation vector in degrees about its own axes."""
    return se3.perturb(pose, np.array([*np.radians(turn), 0.0, 0.0, 0.0]))


def turned_about_lidar(pose: Matrix4, turn: Sequence[float]) -> Matrix4:
    """The camera swings about the origin of the LiDAR, by a rotation vector in degrees about the axes of the LiDAR."""
    return np.asarray(pose @ se3.perturbation(np.array([*np.radians(turn), 0.0, 0.0, 0.0])))


def centre_m(pose: Matrix4) -> NDArray[np.float64]:
    """(3,) of the camera in LiDAR coordinates."""
    return se3.inverse(pose)[:3, 3]


def along_m(pose: Matrix4, axis: int, shift_m: NDArray[np.float64]) -> float:
    """A shift (3,) in LiDAR coordinates along one translation axis of ξ, which is an axis of the camera."""
    return float(pose[axis - 3, :3] @ shift_m)


class Valley:
    """Sharp in rotation and in the centre of the camera, but for one direction of LiDAR coordinates."""

    step_rad = 0.01

    def __init__(self, truth: Matrix4, flat: NDArray[np.float64]) -> None:
        self._truth = truth
        self._flat = flat

    def evaluate(self, T_camera_lidar: Matrix4) -> Evaluation:
        turn = se3.rotation_angle_rad(T_camera_lidar @ se3.inverse(self._truth))
        shift = centre_m(T_camera_lidar) - centre_m(self._truth)
        shift = shift - (shift @ self._flat) * self._flat
        score = float(np.exp(-0.5 * ((turn / 0.1) ** 2 + shift @ shift)))
        return Evaluation(score, np.array([score]), score, 1.0, 1)

    def evaluate_each(self, poses: NDArray[np.float64]) -> list[Evaluation]:
        return [self.evaluate(pose) for pose in poses]


@pytest.mark.parametrize("turned", [turned_about_camera, turned_about_lidar])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (0.0, -20.0, 0.0), (11.0, 11.0, 12.0)])
@pytest.mark.parametrize("axis", [3, 4, 5])
def test_the_centre_stays_where_the_start_had_it_however_the_start_was_turned(
    turned: Turned, turn: tuple[float, float, float], axis: int
) -> None:
    """What slid half a metre along the flat direction comes back to the start's place on it, and the rest to the
    truth."""
    flat = LEVER_ARM[axis - 3, :3]
    valley, start = Valley(LEVER_ARM, flat), turned(LEVER_ARM, turn)
    slid = LEVER_ARM.copy()
    slid[axis - 3, 3] += 0.5
    search = SearchResult(se3.perturb(slid, np.array([0.01, -0.02, 0.01, 0.0, 0.0, 0.0])), 7, StopReason.TOLERANCE)
    result = without((axis,), search, valley, start, SIX, Silence())
    pose = result.T_camera_lidar
    shift = centre_m(pose) - centre_m(start)
    assert abs(along_m(pose, axis, shift)) < 1e-9
    assert se3.rotation_angle_rad(pose @ se3.inverse(LEVER_ARM)) < np.radians(0.01)
    off = centre_m(pose) - centre_m(LEVER_ARM)
    assert np.linalg.norm(off - (off @ flat) * flat) < 1e-3
    assert result.evaluations > 7


def test_putting_the_centre_back_leaves_the_rotation_and_the_other_axes() -> None:
    pose = se3.perturb(LEVER_ARM, np.array([0.3, -0.2, 0.1, 0.4, 0.5, 0.6]))
    back = FixedCentre((4,), LEVER_ARM)(pose)
    np.testing.assert_array_equal(back[:3, :3], pose[:3, :3])
    np.testing.assert_allclose(se3.difference(back, LEVER_ARM)[3:], [0.4, 0.0, 0.6], atol=1e-12)
    assert pose[1, 3] != back[1, 3]


@pytest.mark.parametrize(
    ("second", "sigma", "dof", "axes"),
    [
        ([1.0] * 6, [0.0] * 6, 6, ()),
        ([1.0] * 5 + [-1.0], [0.0] * 5 + [np.nan], 6, (5,)),
        ([1.0] * 6, [0.0] * 3 + [0.2, 0.0, 0.2], 6, (3, 5)),
        ([-1.0] + [1.0] * 5, [9.0] * 6, 3, ()),
        ([np.nan] * 6, [np.nan] * 6, 6, ()),
    ],
    ids=["all told", "no maximum", "too wide", "not searched", "nothing known"],
)
def test_translations_without_a_maximum_or_too_wide_are_unobservable(
    second: list[float], sigma: list[float], dof: int, axes: tuple[int, ...]
) -> None:
    assert LIMITS.max_sigma_m == pytest.approx(0.1)
    assert unobservable(Curvature(np.zeros(6), np.array(second)), np.array(sigma), dof, LIMITS) == axes


# ----------------------------------------------------------------------------------------------- the calibration
TURN = (-12.0, 10.0, 12.0)
"""A turn of 20°."""


def solve(window: Window, depth: DepthModel, start: Matrix4, config: CalibrationConfig) -> Estimate:
    from_start = replace(window, T_camera_lidar_start=start)
    return calibrate(from_start, depth, GreyImages(LimitsConfig()), config, Silence())


@pytest.mark.parametrize("turned", [turned_about_camera, pytest.param(turned_about_lidar, marks=pytest.mark.slow)])
def test_the_retained_axis_of_a_calibration_is_that_of_its_start(
    sharp_street: Window, stereo: DepthModel, turned: Turned
) -> None:
    """Metamorphic: a start that is turned moves no axis that is reported as kept. The limit is put where this street
    tells height and depth, and not how far to the right the camera sits."""
    config = CalibrationConfig(search=SIX, verdict=VerdictConfig(max_sigma_m=0.0036))
    start = turned(sharp_street.rig.T_camera_lidar_nominal, TURN)
    estimate = solve(sharp_street, stereo, start, config)
    retained = np.flatnonzero(estimate.unobservable)
    assert len(retained)
    assert not estimate.solved[retained].any()
    assert np.isnan(estimate.sigma[retained]).all()
    pose = estimate.optimum.T_camera_lidar
    for axis in retained.tolist():
        assert abs(along_m(pose, axis, centre_m(pose) - centre_m(start))) < 1e-3
        if turned is turned_about_camera:  # the start itself has the centre of the truth
            assert abs(estimate.correction[axis]) < 1e-3


def test_a_search_of_rotations_leaves_the_centre_of_the_start(sharp_street: Window, stereo: DepthModel) -> None:
    start = turned_about_lidar(sharp_street.rig.T_camera_lidar_nominal, TURN)
    pose = solve(sharp_street, stereo, start, CalibrationConfig()).optimum.T_camera_lidar
    assert np.linalg.norm(pose[:3, 3] - start[:3, 3]) > 0.02
    np.testing.assert_allclose(centre_m(pose), centre_m(start), atol=1e-9)
