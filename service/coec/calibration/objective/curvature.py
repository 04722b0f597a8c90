"""How peaked and how flat the objective is at an optimum, and how far the optimum may be off by chance.

The numerical first and second derivative of the paper (METHOD, section 1), and a covariance that needs no model of the
noise: the frames of a window are independent checks at one truth, so the scatter of their gradients is the noise of the
sum (the sandwich estimator of maximum-likelihood theory, Huber 1967: J⁻¹·V·J⁻¹).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.differences import FrameScores, across, along
from coec.calibration.objective.mutual_information import Objective
from coec.calibration.steps import of_both
from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.geometry.linear import inverted


@dataclass(frozen=True, slots=True, eq=False)
class Curvature:
    """Shape of the objective at a pose, over the axes rx ry rz tx ty tz; NaN on axes that were not searched.

    Attributes:
        first_derivative: (6,) ∂S/∂ξ, units of the objective per radian or metre.
        second_derivative: (6,) -∂²S/∂ξ², units of the objective per radian² or metre²; positive at a maximum.
        sigma: (6,) standard deviation, radians or metres; NaN where the objective has no maximum or frames are too few.
    """

    first_derivative: NDArray[np.float64]
    second_derivative: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def peakedness(self, score: float) -> NDArray[np.float64]:
        """(3,) -f''/f of the rotations, per radian², where the objective is `score`.

        NaN where the score is not above zero: a share of nothing, or of what is worse than nothing, tells no peak. A
        figure that is not a number passes no limit.
        """
        return np.asarray(self.second_derivative[:3] / (score if score > 0.0 else np.nan))


def measure_curvature(objective: Objective, pose: Matrix4, dof: int, kept: Collection[int] = ()) -> Curvature:
    """Central differences per frame about `pose` (4, 4) on the first `dof` axes, less those in `kept`."""
    moved = [axis for axis in range(dof) if axis not in kept]
    at, steps = _frame_scores_about(objective, pose, moved)
    gradients, second = along(at, steps, range(len(moved)))
    hessian = np.diag(second.mean(axis=1))
    for i, j in combinations(range(len(moved)), 2):
        hessian[i, j] = hessian[j, i] = across(at, steps, i, j).mean()
    return Curvature(
        first_derivative=_padded(gradients.mean(axis=1), moved),
        second_derivative=_padded(-np.diag(hessian), moved),
        sigma=_padded(_sandwich(gradients, -hessian), moved),
    )


def axis_derivatives(objective: Objective, pose: Matrix4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(6,) ∂S/∂ξ and (6,) -∂²S/∂ξ² at `pose` (4, 4), per radian or metre: what `measure_curvature` says of each axis by
    itself, for a fifth of the evaluations."""
    gradients, second = along(*_frame_scores_about(objective, pose, range(6)), range(6))
    return gradients.mean(axis=1), -second.mean(axis=1)


def _frame_scores_about(
    objective: Objective, pose: Matrix4, moved: Sequence[int]
) -> tuple[FrameScores, NDArray[np.float64]]:
    """The scores of the frames (F,) as a function of the perturbation of `pose` along the axes `moved`, and the
    difference step of each."""

    def at(offset: NDArray[np.float64]) -> NDArray[np.float64]:
        perturbation = np.zeros(6)
        perturbation[moved] = offset
        return objective.evaluate(se3.perturb(pose, perturbation)).frame_scores

    return at, of_both(objective.step_rad)[moved]


def _sandwich(gradients: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
    """(dof,) standard deviations from per-frame gradients (dof, F) and the negative Hessian of their mean (dof, dof).

    In plain floats: the last bit of a BLAS product may differ between two processes, and a decision has to replay to
    the byte.
    """
    dof, frames = gradients.shape
    if frames <= dof:  # they cannot span the noise
        return np.full(dof, np.nan)
    try:
        inverse = inverted(information.tolist())
    except ValueError:  # no maximum, and no spread to speak of
        return np.full(dof, np.nan)
    centred = [[g - fsum(row) / frames for g in row] for row in gradients.tolist()]
    # J⁻¹·g of every frame: its own Newton step. Their spread over the root of F is that of the mean. The optimum has
    # used up as many degrees of freedom as there are axes (MacKinnon, White 1985, "HC1").
    steps = [[fsum(inverse[i][j] * centred[j][f] for j in range(dof)) for f in range(frames)] for i in range(dof)]
    return np.array([sqrt(fsum(s * s for s in row) / (frames - dof) / frames) for row in steps])


def _padded(values: NDArray[np.float64], axes: list[int]) -> NDArray[np.float64]:
    padded = np.full(6, np.nan)
    padded[axes] = values
    return padded
