"""The cells of an objective about its optimum, along the axes that were searched: what every part of the uncertainty
looks at."""

from __future__ import annotations

from dataclasses import dataclass
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.cells import Cells
from coec.calibration.types import Matrix4
from coec.geometry import se3


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
        """At a pose (4, 4)."""
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
        """How surely the optimum stands above another pose, of which the cells (F, B) are given: what they are lower
        by, in standard deviations of that difference as frames and sectors scatter.

        On a hill that is a paraboloid it is half the distance in standard deviations of the optimum.
        """
        return certainty(self.centre - cells)


def certainty(gained: NDArray[np.float64]) -> float:
    """How surely cells (F, B) of what one pose gains over another are a gain in all: in standard deviations of their
    sum, as frames and sectors scatter. Nothing gained anywhere is no gain."""
    noise = scatter(gained[None])[0][0]
    total = fsum(gained.ravel().tolist())
    if noise > 0.0:
        return total / sqrt(noise)
    return float(np.copysign(np.inf, total)) if total != 0.0 else 0.0


def scatter(cells: NDArray[np.float64], fitted: int = 0) -> list[list[float]]:
    """(n, n) covariance of the sums of n figures (n, F, B) over their cells, as frames and as sectors differ.

    Cluster-robust both ways (Cameron, Gelbach, Miller 2011), `fitted` degrees of freedom having been used up
    (MacKinnon, White 1985, "HC1"). The term of single cells, which would be subtracted, is left in: so no variance
    is negative, and where frames and sectors are independent the standard deviation is √2 too wide, which the few
    sectors need for their tails. One sector alone tells nothing by itself.
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
