"""The best poses with the camera shifted aside: along a ridge that bends, wherever it goes."""

from __future__ import annotations

import numpy as np
import pytest

from coec.calibration.objective.mutual_information import Cells, Evaluation
from coec.calibration.uncertainty.covariance import translation_profile
from coec.config import CalibrationConfig
from coec.geometry import se3
from support.scenes import Array

CONFIG = CalibrationConfig.model_validate({"search": {"dof": 6}})
OFFSET_M = CONFIG.verdict.max_sigma_m
PITCH_PER_M, BEND_PER_M2 = 0.05, 0.2
"""What pitch makes up for a camera that sits lower; it bends by 2 mrad on 10 cm."""


class BentRidge:
    """Flat along a height that pitch makes up for; all else is told to some mrad or cm."""

    step_rad = 4e-3

    def evaluate(self, T_camera_lidar: Array) -> Evaluation:
        rx, ry, rz, tx, ty, tz = se3.perturbation_log(T_camera_lidar)
        off = np.array([rx - PITCH_PER_M * ty - BEND_PER_M2 * ty**2, ry, rz, 0.1 * tx, 0.1 * tz]) / 3e-3
        return Evaluation(-0.5 * float(off @ off), np.zeros(1), 0.0, 1.0, 1)

    def evaluate_each(self, poses: Array) -> list[Evaluation]:
        return [self.evaluate(pose) for pose in poses]

    def cells(self, T_camera_lidar: Array) -> Cells:
        raise NotImplementedError


@pytest.fixture
def ends() -> Array:
    """(6, 6) ξ of what is found with all six axes searched: across, down and forward, either way."""
    result = translation_profile(BentRidge(), np.eye(4), range(6), CONFIG)
    return np.array([se3.difference(end, result.best) for end in result.others])


def test_it_goes_as_far_along_each_translation_as_one_may_be_off(ends: Array) -> None:
    far = [(axis, way * OFFSET_M) for axis in (3, 4, 5) for way in (1.0, -1.0)]
    assert [end[axis] for end, (axis, _) in zip(ends, far, strict=True)] == pytest.approx([m for _, m in far], abs=1e-5)


def test_a_turn_that_makes_up_for_the_shift_is_followed_around_the_bend(ends: Array) -> None:
    for end, way in zip(ends[2:4], (1.0, -1.0), strict=True):
        expected = PITCH_PER_M * way * OFFSET_M + BEND_PER_M2 * OFFSET_M**2
        assert end[:3] == pytest.approx([expected, 0.0, 0.0], abs=5e-4)


def test_a_translation_that_was_not_searched_stays() -> None:
    result = translation_profile(BentRidge(), np.eye(4), (0, 1, 2, 3, 5), CONFIG)
    heights = [se3.difference(end, result.best)[4] for end in result.others]
    assert heights == pytest.approx([0.0] * 4, abs=1e-9)


def test_a_search_of_turns_alone_has_none() -> None:
    assert translation_profile(BentRidge(), np.eye(4), range(3), CONFIG).others == ()
