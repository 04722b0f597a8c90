"""The sandwich covariance against its plain matrix form, and where there is none."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.objective.curvature import measure_curvature
from coec.calibration.objective.mutual_information import Evaluation
from coec.geometry import se3

FRAMES = 12


class Paraboloids:
    """One quadratic score per frame, each with its own maximum: what the sandwich is exact for."""

    step_rad = 0.01

    def __init__(self, curvature: NDArray[np.float64], maxima: NDArray[np.float64]) -> None:
        self._curvature = curvature
        self._maxima = maxima

    def evaluate(self, T_camera_lidar: NDArray[np.float64]) -> Evaluation:
        away = se3.perturbation_log(T_camera_lidar)[: self._maxima.shape[1]] - self._maxima
        scores = 1.0 - 0.5 * np.einsum("fi,ij,fj->f", away, self._curvature, away)
        return Evaluation(float(scores.mean()), scores, float(scores.mean()), 1.0, 1000)


@pytest.mark.parametrize("dof", [3, 6])
def test_sigma_is_the_spread_of_the_frames_own_maxima_less_the_axes_that_were_fitted_to_them(
    dof: int, rng: np.random.Generator
) -> None:
    root = rng.normal(size=(dof, dof))
    curvature = root @ root.T + np.eye(dof)
    maxima = 1e-4 * rng.normal(size=(FRAMES, dof))
    shape = measure_curvature(Paraboloids(curvature, maxima), np.eye(4), dof)
    expected = maxima.std(axis=0, ddof=dof) / np.sqrt(FRAMES)
    np.testing.assert_allclose(shape.sigma[:dof], expected, rtol=1e-3)
    np.testing.assert_allclose(shape.second_derivative[:dof], np.diag(curvature), rtol=1e-3)
    assert np.isnan(shape.sigma[dof:]).all()


@pytest.mark.parametrize(
    ("curvature", "frames"),
    [(np.diag([1.0, -1.0, 1.0]), FRAMES), (np.eye(3), 3), (np.zeros((3, 3)), FRAMES)],
    ids=["saddle", "fewer frames than it takes", "flat"],
)
def test_without_a_maximum_or_with_too_few_frames_there_is_no_sigma(
    curvature: NDArray[Any], frames: int, rng: np.random.Generator
) -> None:
    objective = Paraboloids(curvature, 1e-3 * rng.normal(size=(frames, 3)))
    assert np.isnan(measure_curvature(objective, np.eye(4), 3).sigma).all()
