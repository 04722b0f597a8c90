"""A summit that cannot be told from the best one widens the covariance; one that can does not."""

from __future__ import annotations

import numpy as np
import pytest

from coec.calibration.objective.mutual_information import Cells, Evaluation
from coec.calibration.solver import Rivals
from coec.calibration.uncertainty.covariance import with_modes
from coec.geometry import se3
from support.scenes import NO_WINDOW_DATA_LINES, Array

AWAY = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
SIGMA = 1e-3
COVARIANCE = (SIGMA**2 * np.eye(3)).tolist()


class TwoSummits:
    """One at the identity, another one `AWAY` from it and lower by `drop` in all, as 10 frames of 5 sectors say, each
    with noise of its own."""

    step_rad = 1e-3

    def __init__(self, drop: float, rng: np.random.Generator) -> None:
        noise = rng.normal(size=(10, 5))
        noise -= noise.mean(axis=0) + noise.mean(axis=1, keepdims=True) - noise.mean()
        of_frames = rng.normal(size=(10, 1)) / 5.0
        self._difference = drop / 50.0 + noise + of_frames - of_frames.mean()

    def evaluate(self, T_camera_lidar: Array) -> Evaluation:
        raise NotImplementedError

    def evaluate_each(self, poses: Array) -> list[Evaluation]:
        raise NotImplementedError

    def cells(self, T_camera_lidar: Array) -> Cells:
        assert np.allclose(T_camera_lidar, np.eye(4))  # cut at the best one
        return Cells(self._at, self.step_rad, NO_WINDOW_DATA_LINES)

    def _at(self, poses: Array) -> Array:
        return np.array([np.zeros((10, 5)) if np.allclose(pose, np.eye(4)) else -self._difference for pose in poses])


def sigma_yaw(drop: float, rng: np.random.Generator, away: Array = AWAY) -> float:
    rivals = Rivals(TwoSummits(drop, rng), np.eye(4), (se3.perturbation(away),))
    return float(np.sqrt(with_modes(rivals, range(3), COVARIANCE)[1][1]))


def test_summits_of_equal_height_are_both_within_one_sigma(rng: np.random.Generator) -> None:
    assert sigma_yaw(0.0, rng) == pytest.approx(AWAY[1] / np.sqrt(2.0), rel=0.01)


def test_one_that_stands_higher_counts_as_much_as_the_best(rng: np.random.Generator) -> None:
    assert sigma_yaw(-50.0, rng) == pytest.approx(AWAY[1] / np.sqrt(2.0), rel=0.01)


def test_one_that_is_surely_lower_counts_nothing(rng: np.random.Generator) -> None:
    assert sigma_yaw(50.0, rng) == pytest.approx(SIGMA, rel=0.01)


def test_a_pose_on_the_same_hill_is_no_other_summit(rng: np.random.Generator) -> None:
    assert sigma_yaw(0.0, rng, 0.1 * AWAY) == SIGMA
