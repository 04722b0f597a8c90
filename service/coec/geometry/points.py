"""Arrays whose rows are vectors, random subsets of many points, and the scan lines of a sweep. NumPy alone: the
process that records, which thins sweeps by rows, loads no compiler.

A stride would be as fast, but a sweep comes in the order in which its beams fire: with sixteen beams, every second
point belongs to the same eight beams. A random choice has no such period.
"""

import math
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Precision = TypeVar("Precision", np.float32, np.float64)


def rows_of(name: str, array: NDArray[np.floating], columns: int) -> NDArray[np.float64]:
    """The array as contiguous float64 (N, columns). Raises ValueError, which names it `name`, for any other shape."""
    rows = np.ascontiguousarray(array, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ValueError(f"{name} must have the shape (N, {columns}), got {rows.shape}")
    return rows


def lengths(vectors: NDArray[Precision]) -> NDArray[Precision]:
    """(N,) lengths of vectors (N, 3), equal to the bit to `np.linalg.norm`, which takes twelve times as long because it
    adds up row by row."""
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x * x + y * y + z * z), vectors.dtype)


def random_direction(rng: np.random.Generator) -> NDArray[np.float64]:
    """A unit vector (3,), uniform over all directions, from three normal numbers."""
    normal = rng.normal(size=3)
    return np.asarray(normal / np.sqrt((normal**2).sum()))


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


BAND_RAD = math.radians(0.42)
"""Height of a band of elevation if no ring is known: the beam spacing of a 64-beam sensor. Wider bands only cost time;
narrower ones cut scan lines of a tilted sensor into pieces."""


def distinct_rings(ring: NDArray[np.uint16] | None) -> NDArray[np.uint16] | None:
    """The rings (N,) if they distinguish beams; None if there are none, or if the driver fills the field with one
    number for all beams."""
    if ring is None or not len(ring) or ring.min() == ring.max():
        return None
    return ring
