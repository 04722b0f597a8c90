"""Central differences: the first and second derivatives of what several frames say, each frame by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

FrameScores = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""The scores of F frames (F,) at an offset (n,) from the place of the derivatives."""


def along(
    at: FrameScores, steps: NDArray[np.float64], axes: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients and second derivatives, (len(axes), F) each, along some of n axes; `steps` (n,) are the differences."""
    shifts, centre = np.diag(steps), at(np.zeros(len(steps)))
    plus = np.array([at(shifts[axis]) for axis in axes])
    minus = np.array([at(-shifts[axis]) for axis in axes])
    of_axes = steps[list(axes), None]
    return (plus - minus) / (2.0 * of_axes), (plus + minus - 2.0 * centre) / of_axes**2


def across(at: FrameScores, steps: NDArray[np.float64], i: int, j: int) -> NDArray[np.float64]:
    """(F,) the mixed second derivative of two of n axes."""
    shifts = np.diag(steps)
    both, against = shifts[i] + shifts[j], shifts[i] - shifts[j]
    return np.asarray((at(both) + at(-both) - at(against) - at(-against)) / (4.0 * steps[i] * steps[j]))
