"""How peaked and how flat the objective is at an optimum, and how far the optimum may be off by chance.

The numerical first and second derivative of the paper (METHOD, section 1), and a covariance that needs no model of the
noise: the frames of a window are independent looks at one truth, so the scatter of their gradients is the noise of the
sum (the sandwich estimator of maximum-likelihood theory, Huber 1967: J⁻¹·V·J⁻¹).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective import Objective
from coec.calibration.values import Matrix4
from coec.geometry import se3

METRES_PER_RADIAN = 6.0
"""Difference step of a translation per step of a rotation: moves a point 6 m away as far."""


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


def measure_curvature(objective: Objective, pose: Matrix4, dof: int) -> Curvature:
    """Central differences per frame about `pose` (4, 4) on the first `dof` axes."""
    steps = objective.step_rad * np.array([1.0] * 3 + [METRES_PER_RADIAN] * 3)[:dof]

    def at(offset: NDArray[np.float64]) -> NDArray[np.float64]:
        perturbation = np.zeros(6)
        perturbation[:dof] = offset
        return objective.evaluate(se3.perturb(pose, perturbation)).frame_scores

    axes = np.diag(steps)
    centre = at(np.zeros(dof))
    plus = np.array([at(axis) for axis in axes])
    minus = np.array([at(-axis) for axis in axes])
    gradients = (plus - minus) / (2.0 * steps[:, None])  # (dof, F)
    hessian = np.diag((plus + minus - 2.0 * centre).mean(axis=1) / steps**2)
    for i, j in combinations(range(dof), 2):
        both, against = axes[i] + axes[j], axes[i] - axes[j]
        mixed = (at(both) + at(-both) - at(against) - at(-against)).mean()
        hessian[i, j] = hessian[j, i] = mixed / (4.0 * steps[i] * steps[j])
    return Curvature(
        first_derivative=_padded(gradients.mean(axis=1)),
        second_derivative=_padded(-np.diag(hessian)),
        sigma=_padded(_sandwich(gradients, -hessian)),
    )


def _sandwich(gradients: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
    """(dof,) standard deviations from per-frame gradients (dof, F) and the negative Hessian of their mean (dof,
    dof)."""
    dof, frames = gradients.shape
    # Fewer frames than axes cannot span the noise; without a maximum there is no spread to speak of.
    if frames <= dof or np.linalg.eigvalsh(information)[0] <= 0.0:
        return np.full(dof, np.nan)
    inverse = np.linalg.inv(information)
    noise = np.atleast_2d(np.cov(gradients)) / frames
    return np.asarray(np.sqrt(np.diag(inverse @ noise @ inverse)))


def _padded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([values, np.full(6 - len(values), np.nan)])
