"""A maximum in a box with BOBYQA (Powell 2009, NLopt): bounded, derivative-free, deterministic."""

from __future__ import annotations

from collections.abc import Callable
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


def maximum_in(
    box: Box, score: Callable[[NDArray[np.float64]], float], start: NDArray[np.float64], max_evaluations: int
) -> tuple[NDArray[np.float64], bool]:
    """The best coordinates (n,) of the box that a search from `start` (n,) comes to, and whether its evaluations ran
    out before it came to an end."""
    optimiser = nlopt.opt(nlopt.LN_BOBYQA, len(start))
    optimiser.set_lower_bounds(box.lower)
    optimiser.set_upper_bounds(box.upper)
    # The first quadratic model needs two steps of room between the bounds.
    optimiser.set_initial_step(np.minimum(box.step, (box.upper - box.lower) / 2.0))
    optimiser.set_xtol_abs(box.tolerance)
    optimiser.set_maxeval(max_evaluations)
    optimiser.set_max_objective(lambda x, _gradient: score(x))
    found = np.asarray(optimiser.optimize(start))
    return found, optimiser.last_optimize_result() == nlopt.MAXEVAL_REACHED
