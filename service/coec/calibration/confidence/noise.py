"""The error of an optimum by chance: other frames, or other things in them, would have put it elsewhere.

It is the sandwich of maximum-likelihood theory (Huber 1967), J⁻¹·V·J⁻¹, with V from the scatter of the score between
frames and between sectors of the image. Both are needed: all frames of a standing vehicle show the same and so agree on
anything, but its sectors, which show different things, do not; and a wrong lens acts on a sector in every frame alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.landscape import Landscape, scatter
from coec.calibration.objective.differences import across, along
from coec.calibration.steps import of_both
from coec.geometry.linear import Rows, congruent, eigen, inverted

WIDER = (1.0, 2.0, 4.0)
"""Difference steps, in steps of the cells, that are tried until the objective has a maximum: a ripple may dent the top
of a hill."""

SAME = 1e-9
"""If frames differ, the smallest axis of the scatter has at least this share of the largest, with each figure in units
of its standard deviation. Frames that repeat one another leave 1e-16, the rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """The spread of an optimum by chance.

    Attributes:
        covariance: (n, n) of the axes that were searched, radians and metres.
        information: (n, n) negative Hessian of the objective, likewise.
        looks: how many independent looks the frames are worth for the place of the optimum: as many as there are, if
            what a frame says of a sector is independent of the other frames; one, if all say the same. How often they
            say that this is the right hill is another question: see `confidence.looks`.
    """

    covariance: list[list[float]]
    information: list[list[float]]
    independent_samples: float


def measure_noise(landscape: Landscape) -> Noise | None:
    """The noise, by central differences. None if the objective has no maximum, or if too few frames differ: two views
    in turn, however often, scatter along one line and would leave the other axes without any error."""
    fitted = len(landscape.moved)
    if landscape.frames <= fitted:
        return None
    for wider in WIDER:
        gradients, information = _derivatives(landscape, wider * landscape.cells.step_rad)
        try:
            inverse = inverted(information)
        except ValueError:
            continue
        scattered = scatter(gradients, fitted)
        if not _is_of_full_rank(scattered):
            return None
        return Noise(congruent(inverse, scattered), information, effective_frame_count(gradients, inverse))
    return None


def _derivatives(landscape: Landscape, step_rad: float) -> tuple[NDArray[np.float64], list[list[float]]]:
    """The gradient (n, F, B) of each cell, and the negative Hessian (n, n) of their sum."""
    shape, count = landscape.centre.shape, len(landscape.moved)
    steps = of_both(step_rad)[list(landscape.moved)]

    def at(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        return landscape.at(offsets).reshape(len(offsets), -1)

    gradients, second = along(at, steps, range(count))
    information = [[0.0] * count for _ in range(count)]
    for i in range(count):
        information[i][i] = -fsum(second[i].tolist())
    pairs = list(combinations(range(count), 2))
    for (i, j), mixed in zip(pairs, across(at, steps, pairs), strict=True):
        information[i][j] = information[j][i] = -fsum(mixed.tolist())
    return gradients.reshape(count, *shape), information


def _is_of_full_rank(covariance: Rows) -> bool:
    """Whether every combination of the figures scatters."""
    deviations = [sqrt(row[i]) for i, row in enumerate(covariance)]
    if min(deviations) == 0.0:
        return False
    of_all = range(len(covariance))
    values = eigen([[covariance[i][j] / deviations[i] / deviations[j] for j in of_all] for i in of_all])
    return values[-1][0] > SAME * values[0][0]


def effective_frame_count(gradients: NDArray[np.float64], inverse: list[list[float]]) -> float:
    """The number of independent looks of F frames, from the gradients (n, F, B) of their cells and the inverse (n, n)
    of the information. It is F over the design effect (Kish 1965): how much more the sectors scatter than they would if
    the cells of each frame were independent of those of the others."""
    n, frames, _ = gradients.shape

    def size(groups: NDArray[np.float64]) -> float:
        rows = groups.reshape(n, -1).tolist()
        squares = [[fsum(a * b for a, b in zip(one, other, strict=True)) for other in rows] for one in rows]
        return fsum(inverse[i][j] * squares[j][i] for i in range(n) for j in range(n))

    together = size(gradients.sum(axis=1))
    return min(max(frames * size(gradients) / together, 1.0), float(frames)) if together > 0.0 else float(frames)
