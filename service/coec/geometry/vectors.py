"""Arrays whose rows are vectors: points, rays, pixels."""

from __future__ import annotations

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
