"""A random choice of some of many points of a sweep, range edges or pixels, where all would take too long.

A stride would be as fast, but a sweep comes in the order in which its beams fire: with sixteen beams, every second
point belongs to the same eight beams. A random choice has no such period.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

SEED = 16_384
"""An arbitrary number. The choice depends on the two counts alone, so that a replay chooses the same."""

CACHED_SUBSETS = 16
"""Choices kept in memory, of up to a hundred thousand numbers each (13 MB in all). They recur, because the images of a
window have one size, and so have the sweeps of many sensors."""


@lru_cache(maxsize=CACHED_SUBSETS)
def thinned(count: int, at_most: int) -> NDArray[np.int64]:
    """Indices (n,), ascending, of `at_most` of `count` things, each chosen with the same probability; of all things if
    there are not more. The array is read-only because every caller with these counts gets the same one.

    The beginning of a seeded permutation (Fisher, Yates 1938), sorted so that memory is read in one direction.

    Raises:
        ValueError: a count is negative.
    """
    if count < 0 or at_most < 0:
        raise ValueError(f"counts must not be negative: {at_most} of {count}")
    if at_most >= count:
        indices = np.arange(count)
    else:
        indices = np.sort(np.random.default_rng([SEED, count, at_most]).choice(count, at_most, False, shuffle=False))
    indices.flags.writeable = False
    return indices
