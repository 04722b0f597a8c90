"""Other poses, which the search found or started from, that the window cannot distinguish from the best one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, fsum

import numpy as np

from coec.calibration.confidence.landscape import Landscape
from coec.calibration.objective.mutual_information import Divisible
from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.geometry.linear import solved

SAME_HILL = 3.0
"""A pose within this many standard deviations belongs to the hill of the optimum, whose width is counted already."""


@dataclass(frozen=True, slots=True, eq=False)
class Rivals:
    """Poses under one objective: the best (4, 4), and `others` (4, 4) that might be the true one."""

    objective: Divisible
    best: Matrix4
    others: tuple[Matrix4, ...]


def with_modes(rivals: Rivals, moved: Sequence[int], covariance: list[list[float]]) -> list[list[float]]:
    """The covariance (n, n) of the axes `moved`, about the best summit, of a mixture with the other summits.

    A summit has the weight exp(-2·c²), where c is the certainty by which the best one stands above it. That is the
    likelihood exp(-d²/2) of a pose that is as far down on a paraboloid. A summit above the best has the weight 1.
    """
    axes = tuple(moved)
    aways = [se3.difference(other, rivals.best)[list(axes)].tolist() for other in rivals.others]
    aways_and_poses = [
        (away, other) for away, other in zip(aways, rivals.others, strict=True) if _on_another_hill(away, covariance)
    ]
    if not aways_and_poses:
        return covariance
    landscape = Landscape.about(rivals.objective.cells(rivals.best), rivals.best, axes)
    at_others = landscape.cells.at(np.array([other for _, other in aways_and_poses]))
    weighted = [
        (exp(-2.0 * max(landscape.certainty(cells), 0.0) ** 2), away)
        for (away, _), cells in zip(aways_and_poses, at_others, strict=True)
    ]
    whole = 1.0 + fsum(weight for weight, _ in weighted)
    n = range(len(axes))
    return [[covariance[i][j] + fsum(w * away[i] * away[j] for w, away in weighted) / whole for j in n] for i in n]


def _on_another_hill(away: list[float], covariance: list[list[float]]) -> bool:
    """Whether a summit that lies `away` (n,) from the best one is on another hill."""
    return fsum(a * b for a, b in zip(away, solved(covariance, away), strict=True)) > SAME_HILL**2
