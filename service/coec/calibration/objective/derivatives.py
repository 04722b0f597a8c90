"""Numerical derivatives: central differences of the scores of several frames, each frame by itself; and how steep and
how peaked the objective is at an optimum (METHOD, section 1).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import Objective
from coec.calibration.search.prior import of_both
from coec.calibration.types import Matrix4
from coec.geometry import se3

FrameScores = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""The scores of F frames (K, F) at each of K offsets (K, n) from the place of the derivatives."""


def along(
    at: FrameScores, steps: NDArray[np.float64], axes: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients and second derivatives, each (len(axes), F), along some of n axes; `steps` (n,) are the difference
    steps."""
    shifts = np.diag(steps)[list(axes)]
    centre, *neighbours = at(np.concatenate([np.zeros((1, len(steps))), shifts, -shifts]))
    plus, minus = np.array(neighbours[: len(axes)]), np.array(neighbours[len(axes) :])
    of_axes = steps[list(axes), None]
    return (plus - minus) / (2.0 * of_axes), (plus + minus - 2.0 * centre) / of_axes**2


def across(at: FrameScores, steps: NDArray[np.float64], pairs: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """(len(pairs), F) the mixed second derivatives of pairs of n axes."""
    shifts, offsets = np.diag(steps), []
    for i, j in pairs:
        both, against = shifts[i] + shifts[j], shifts[i] - shifts[j]
        offsets += [both, -both, against, -against]
    values = at(np.array(offsets).reshape(-1, len(steps)))
    of_pairs = np.array([4.0 * steps[i] * steps[j] for i, j in pairs])[:, None]
    return np.asarray((values[::4] + values[1::4] - values[2::4] - values[3::4]) / of_pairs)


@dataclass(frozen=True, slots=True, eq=False)
class Curvature:
    """Shape of the objective at a pose, over the axes rx ry rz tx ty tz; NaN on axes that were not searched.

    Attributes:
        first_derivative: (6,) ∂S/∂ξ, units of the objective per radian or metre.
        second_derivative: (6,) -∂²S/∂ξ², units of the objective per radian² or metre²; positive at a maximum.
    """

    first_derivative: NDArray[np.float64]
    second_derivative: NDArray[np.float64]

    def peakedness(self, score: float) -> NDArray[np.float64]:
        """(3,) -f''/f of the rotations, per radian², for an objective of `score`.

        NaN if the score is not above zero, because a share of it then says nothing about a peak. NaN passes no limit.
        """
        return np.asarray(self.second_derivative[:3] / (score if score > 0.0 else np.nan))


def measure_curvature(objective: Objective, pose: Matrix4, dof: int, fixed: Collection[int] = ()) -> Curvature:
    """The curvature by central differences about `pose` (4, 4), on the first `dof` axes except those in `kept`."""
    axes = [axis for axis in range(dof) if axis not in fixed]
    first, second = _derivatives(objective, pose, axes)
    return Curvature(_padded(first, axes), _padded(second, axes))


def axis_derivatives(objective: Objective, pose: Matrix4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(6,) ∂S/∂ξ and (6,) -∂²S/∂ξ² at `pose` (4, 4), per radian or metre."""
    return _derivatives(objective, pose, range(6))


def _derivatives(
    objective: Objective, pose: Matrix4, axes: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    def at(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        poses = np.array([se3.perturb(pose, offset) for offset in offsets])
        return np.array([evaluation.frame_scores for evaluation in objective.evaluate_each(poses)])

    gradients, second = along(at, of_both(objective.step_rad), axes)
    return gradients.mean(axis=1), -second.mean(axis=1)


def _padded(values: NDArray[np.float64], axes: list[int]) -> NDArray[np.float64]:
    padded = np.full(6, np.nan)
    padded[axes] = values
    return padded
