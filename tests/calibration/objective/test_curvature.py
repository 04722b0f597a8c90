"""Derivatives of a hill, against what it was made of."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.objective.landscape import measure_curvature
from coec.calibration.objective.mutual_information import Evaluation
from coec.geometry import se3


class Paraboloid:
    """A quadratic score about a maximum away from the pose."""

    step_rad = 0.01

    def __init__(self, curvature: NDArray[np.float64], maximum: NDArray[np.float64]) -> None:
        self._curvature = curvature
        self._maximum = maximum

    def evaluate(self, T_camera_lidar: NDArray[np.float64]) -> Evaluation:
        away = se3.perturbation_log(T_camera_lidar) - self._maximum
        score = 1.0 - 0.5 * float(away @ self._curvature @ away)
        return Evaluation(score, np.array([score]), score, 1.0, 1000)

    def evaluate_each(self, poses: NDArray[np.float64]) -> list[Evaluation]:
        return [self.evaluate(pose) for pose in poses]


@pytest.mark.parametrize(("dof", "retained"), [(3, ()), (6, ()), (6, (4,))])
def test_derivatives_are_those_of_the_axes_that_were_searched(
    dof: int, retained: tuple[int, ...], rng: np.random.Generator
) -> None:
    root = rng.normal(size=(6, 6))
    square, maximum = root @ root.T + np.eye(6), 1e-4 * rng.normal(size=6)
    shape = measure_curvature(Paraboloid(square, maximum), np.eye(4), dof, retained)
    moved = [axis for axis in range(dof) if axis not in retained]
    still = [axis for axis in range(6) if axis not in moved]
    np.testing.assert_allclose(shape.first_derivative[moved], (square @ maximum)[moved], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(shape.second_derivative[moved], np.diag(square)[moved], rtol=1e-3)
    assert np.isnan(shape.first_derivative[still]).all()
    assert np.isnan(shape.second_derivative[still]).all()
