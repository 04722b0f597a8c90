"""Some of many, where all would take too long: points of a sweep, range edges, pixels.

A stride would do it as fast, but a sweep comes in the order in which its beams fire: of a sensor of sixteen beams,
every second point is eight of them. A choice at random has no beat that anything could fall in with.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

SEED = 16_384
"""Any number. What is chosen depends on the two counts alone, so a replay chooses the same."""

KEPT_CHOICES = 16
"""Choices that are remembered, of up to a hundred thousand numbers each (13 MB in all): the images of a window have one
size, and so have the sweeps of many a sensor."""


@lru_cache(maxsize=KEPT_CHOICES)
def thinned(count: int, at_most: int) -> NDArray[np.int64]:
    """Indices (n,) of `at_most` of `count` things, ascending, each as likely as any other; of all where there are no
    more. Read-only: the same array is handed out to all who ask for these counts.

    The beginning of a seeded permutation (Fisher, Yates 1938), put in order so that memory is read in one direction.

    Raises:
        ValueError: a count is negative.
    """
    if count < 0 or at_most < 0:
        raise ValueError(f"counts must not be negative: {at_most} of {count}")
    if at_most >= count:
        chosen = np.arange(count)
    else:
        chosen = np.sort(np.random.default_rng([SEED, count, at_most]).choice(count, at_most, False, shuffle=False))
    chosen.flags.writeable = False
    return chosen
