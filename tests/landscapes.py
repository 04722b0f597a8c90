"""Landscapes of cells whose optimum scatters by a known law."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.landscape import Landscape
from coec.calibration.objective.cells import Cells, PointsInView
from coec.geometry import se3

Array = NDArray[np.float64]

NO_SIGHT_LINES = PointsInView(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))


def landscape(score: Callable[[Array], Array], axes: int = 3, step_rad: float = 1e-3) -> Landscape:
    """Of cells (F, B) as a function of the perturbation (6,), about no perturbation."""
    return Landscape.about(
        Cells(lambda poses: np.array([score(se3.perturbation_log(pose)) for pose in poses]), step_rad, NO_SIGHT_LINES),
        np.eye(4),
        tuple(range(axes)),
    )


def paraboloids(square: Array, maxima: Array) -> Callable[[Array], Array]:
    """A quadratic score (n, n) in each cell, with a maximum (F, B, n) of its own."""
    n = maxima.shape[-1]

    def score(xi: Array) -> Array:
        away = xi[:n] - maxima
        return np.asarray(-0.5 * np.einsum("fbi,ij,fbj->fb", away, square, away))

    return score
