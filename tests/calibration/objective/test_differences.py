"""Central differences on polynomials, whose derivatives are known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.landscape import across, along

LINEAR = np.array([[1.0, -2.0, 0.5], [0.0, 3.0, -1.0]])
"""Of two frames, along three axes."""

SQUARE = np.array([[[2.0, 0.3, -0.4], [0.3, -1.0, 0.2], [-0.4, 0.2, 0.7]], np.diag([1.0, 2.0, 3.0])])
STEPS = np.array([0.1, 0.02, 0.5])


def scores(xs: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([5.0 + LINEAR @ x + 0.5 * np.einsum("i,fij,j->f", x, SQUARE, x) for x in xs])


def test_gradients_and_second_derivatives_are_those_of_each_frame() -> None:
    gradients, second = along(scores, STEPS, range(3))
    np.testing.assert_allclose(gradients, LINEAR.T, atol=1e-12)
    np.testing.assert_allclose(second, np.diagonal(SQUARE, axis1=1, axis2=2).T, atol=1e-9)


def test_some_axes_alone_are_those_of_all() -> None:
    gradients, second = along(scores, STEPS, range(3))
    some = along(scores, STEPS, (2, 0))
    np.testing.assert_array_equal(some[0], gradients[[2, 0]])
    np.testing.assert_array_equal(some[1], second[[2, 0]])


def test_mixed_derivatives_are_those_of_each_frame() -> None:
    pairs = [(0, 1), (0, 2), (2, 1)]
    np.testing.assert_allclose(across(scores, STEPS, pairs), [SQUARE[:, i, j] for i, j in pairs], atol=1e-9)
