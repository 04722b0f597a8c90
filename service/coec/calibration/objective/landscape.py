"""An objective about an optimum: its derivatives, how peaked it is there (METHOD, section 1), and how its cells scatter
over frames and sectors, which gives the significance of a difference between two poses.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import Cells, Objective
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
    """The curvature by central differences about `pose` (4, 4), on the first `dof` axes except those in `fixed`."""
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

    gradients, second = along(at, se3.axis_steps(objective.step_rad), axes)
    return gradients.mean(axis=1), -second.mean(axis=1)


def _padded(values: NDArray[np.float64], axes: list[int]) -> NDArray[np.float64]:
    padded = np.full(6, np.nan)
    padded[axes] = values
    return padded


@dataclass(frozen=True, slots=True, eq=False)
class Landscape:
    """Cells as a function of the offset from an optimum.

    Attributes:
        cells: cut at the optimum.
        pose: (4, 4) the optimum.
        moved: the n axes of ξ that were searched.
        centre: (F, B) the cells at the optimum.
    """

    cells: Cells
    pose: Matrix4
    moved: tuple[int, ...]
    centre: NDArray[np.float64]

    @classmethod
    def about(cls, cells: Cells, pose: Matrix4, moved: tuple[int, ...]) -> Landscape:
        """The landscape about a pose (4, 4)."""
        return cls(cells, pose, moved, cells.at(pose[None])[0])

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.centre)

    def at(self, offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, F, B) the cells at each of K offsets (K, n) along the axes moved."""
        xi = np.zeros((len(offsets), 6))
        xi[:, list(self.moved)] = offsets
        return self.cells.at(np.array([se3.perturb(self.pose, one) for one in xi]))

    def certainty(self, cells: NDArray[np.float64]) -> float:
        """How surely the optimum stands above another pose whose cells (F, B) are given: the difference in standard
        deviations, from the scatter of that difference over frames and sectors.

        On a paraboloid it is half the distance from the optimum in standard deviations of the optimum.
        """
        return certainty(self.centre - cells)


def certainty(gained: NDArray[np.float64]) -> float:
    """How surely one pose gains over another in all, from the gain in each cell (F, B): the sum in its standard
    deviations, from the scatter over frames and sectors. It is 0 if no cell gains anything."""
    noise = scatter(gained[None])[0][0]
    total = fsum(gained.ravel().tolist())
    if noise > 0.0:
        return total / sqrt(noise)
    return float(np.copysign(np.inf, total)) if total != 0.0 else 0.0


def scatter(cells: NDArray[np.float64], fitted: int = 0) -> list[list[float]]:
    """(n, n) covariance of the sums of n figures (n, F, B) over their cells, from how frames and sectors differ.

    Cluster-robust both ways (Cameron, Gelbach, Miller 2011), with `fitted` degrees of freedom used up (MacKinnon, White
    1985, "HC1"). The term of single cells, which would be subtracted, is left in. So no variance is negative, and if
    frames and sectors are independent the standard deviation is √2 too wide, which the few sectors need for their
    tails. A single sector contributes nothing.
    """
    figures = len(cells)
    of_frames, of_sectors = cells.sum(axis=2).tolist(), cells.sum(axis=1).tolist()
    covariance = [[0.0] * figures for _ in range(figures)]
    for groups in (of_frames, of_sectors):
        count = len(groups[0])
        if count <= max(fitted, 1):
            continue
        means = [fsum(row) / count for row in groups]
        centred = [[value - mean for value in row] for row, mean in zip(groups, means, strict=True)]
        factor = count / (count - max(fitted, 1))
        for i in range(figures):
            for j in range(figures):
                covariance[i][j] += factor * fsum(a * b for a, b in zip(centred[i], centred[j], strict=True))
    return covariance
