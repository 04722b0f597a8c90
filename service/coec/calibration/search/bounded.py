"""Finds a maximum in a box with BOBYQA (Powell 2009, NLopt): bounded, derivative-free, deterministic."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import nlopt
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Where to search, in the units of each of n axes.

    Attributes:
        lower, upper: (n,) bounds.
        step: (n,) first trust region.
        tolerance: (n,) last trust region.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    step: NDArray[np.float64]
    tolerance: NDArray[np.float64]


Scores = Callable[[NDArray[np.float64]], Sequence[float]]
"""The scores of K points (K, n), each by itself."""


def maximum_in(
    box: Box, scores: Scores, start: NDArray[np.float64], max_evaluations: int
) -> tuple[NDArray[np.float64], bool]:
    """The best coordinates (n,) in the box that a search from `start` (n,) finds, and whether its evaluations ran out
    before it ended.

    The first points do not depend on their scores, so they are scored together; the others are scored one by one.
    """
    # The first quadratic model needs two steps of room between the bounds.
    step = np.minimum(box.step, (box.upper - box.lower) / 2.0)
    first = _first_points(start, step)[:max_evaluations]
    known = dict(zip((point.tobytes() for point in first), scores(first), strict=True))

    def score(point: NDArray[np.float64], _gradient: NDArray[np.float64]) -> float:
        cached = known.pop(point.tobytes(), None)
        return scores(point[None])[0] if cached is None else cached

    optimiser = nlopt.opt(nlopt.LN_BOBYQA, len(start))
    optimiser.set_lower_bounds(box.lower)
    optimiser.set_upper_bounds(box.upper)
    optimiser.set_initial_step(step)
    optimiser.set_xtol_abs(box.tolerance)
    optimiser.set_maxeval(max_evaluations)
    optimiser.set_max_objective(score)
    best = np.asarray(optimiser.optimize(start))
    return best, optimiser.last_optimize_result() == nlopt.MAXEVAL_REACHED


def _first_points(start: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2·n + 1, n) the points of BOBYQA's first model: the start, and a step either way along each axis. Where the box
    has no room for both steps, BOBYQA begins at other points."""
    return np.concatenate([start[None], start + np.diag(step), start - np.diag(step)])
