"""Central differences: first and second derivatives of the scores of several frames, each frame by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

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
