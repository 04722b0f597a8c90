"""The paper's derivatives of a look, on every axis."""

from __future__ import annotations

import numpy as np

from coec.calibration.confidence import axis_derivatives, measure_curvature
from coec.calibration.objective import Evaluation
from coec.calibration.values import Matrix4
from coec.geometry import se3

CENTRE = np.array([0.01, -0.02, 0.005, 0.02, 0.01, -0.03])
PEAKEDNESS = np.array([3.0, 2.0, 1.0, 0.5, 0.4, 0.3])


class Hill:
    """-½ Σ p (ξ - c)² in two frames."""

    step_rad = 1e-3

    def evaluate(self, T_camera_lidar: Matrix4) -> Evaluation:
        off = se3.difference(T_camera_lidar, np.eye(4)) - CENTRE
        score = float(-0.5 * (PEAKEDNESS * off**2).sum())
        frames = np.array([score - 1.0, score + 1.0])
        return Evaluation(score, frames, mi=score, overlap=1.0, points_in_view=1)


def test_are_those_of_the_hill() -> None:
    first, second = axis_derivatives(Hill(), np.eye(4))
    np.testing.assert_allclose(first, PEAKEDNESS * CENTRE, rtol=1e-6)
    np.testing.assert_allclose(second, PEAKEDNESS, rtol=1e-6)


def test_are_those_of_the_curvature() -> None:
    first, second = axis_derivatives(Hill(), np.eye(4))
    curvature = measure_curvature(Hill(), np.eye(4), 6)
    np.testing.assert_array_equal(first, curvature.first_derivative)
    np.testing.assert_array_equal(second, curvature.second_derivative)
