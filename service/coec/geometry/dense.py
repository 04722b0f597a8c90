"""Small dense linear algebra on stacks of matrices, without BLAS and LAPACK: the last bit of their products may differ
between two processes, and decisions have to be the same to the byte.

`linear` does the same for one matrix in plain floats. Here all matrices of a stack go through each step together, which
is fast enough for some thousand of them, or for one with a hundred rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def product(a: Array, b: Array) -> Array:
    """A·B (..., n, p) of (..., n, m) and (..., m, p)."""
    total = np.zeros((*np.broadcast_shapes(a.shape[:-2], b.shape[:-2]), a.shape[-2], b.shape[-1]))
    for k in range(a.shape[-1]):
        total += a[..., :, k, None] * b[..., None, k, :]
    return total


def applied(a: Array, x: Array) -> Array:
    """A·x (..., n) of (..., n, m) and (..., m)."""
    return product(a, x[..., None])[..., 0]


def squared(a: Array, x: Array) -> Array:
    """xᵀ·A·x (...) of (..., n, n) and (..., n)."""
    image = applied(a, x)
    total = np.zeros(image.shape[:-1])
    for k in range(image.shape[-1]):
        total += image[..., k] * x[..., k]
    return total


def cholesky(a: Array) -> Array:
    """L (..., n, n), lower, of symmetric positive definite matrices L·Lᵀ.

    Raises:
        ValueError: one of them is not positive definite.
    """
    rest = np.array(a, np.float64)
    factor = np.zeros_like(rest)
    for k in range(rest.shape[-1]):
        pivot = rest[..., k, k]
        if not (pivot > 0.0).all():
            raise ValueError(f"a matrix is not positive definite: its pivot {k} is {float(np.min(pivot)):.3g}")
        column = rest[..., k:, k] / np.sqrt(pivot)[..., None]
        factor[..., k:, k] = column
        rest[..., k:, k:] -= column[..., :, None] * column[..., None, :]
    return factor


def log_determinant(factor: Array) -> Array:
    """Logarithms (...) of the determinants of L·Lᵀ, from L (..., n, n)."""
    total = np.zeros(factor.shape[:-2])
    for k in range(factor.shape[-1]):
        total += np.log(factor[..., k, k])
    return 2.0 * total


def cholesky_solve(factor: Array, right: Array) -> Array:
    """The solution X (..., n, p) of L·Lᵀ·X = B (..., n, p)."""
    n = factor.shape[-1]
    shape = np.broadcast_shapes(factor.shape[:-2], right.shape[:-2])
    x = np.array(np.broadcast_to(right, (*shape, *right.shape[-2:])), np.float64)
    for k in range(n):
        x[..., k, :] /= factor[..., k, k, None]
        x[..., k + 1 :, :] -= factor[..., k + 1 :, k, None] * x[..., None, k, :]
    for k in reversed(range(n)):
        x[..., k, :] /= factor[..., k, k, None]
        x[..., :k, :] -= factor[..., k, :k, None] * x[..., None, k, :]
    return x


def inverse(a: Array) -> Array:
    """Inverses (..., n, n), exactly symmetric, of symmetric positive definite matrices.

    Raises:
        ValueError: one of them is not positive definite.
    """
    x = cholesky_solve(cholesky(a), np.broadcast_to(np.eye(a.shape[-1]), a.shape))
    return np.asarray(0.5 * (x + np.swapaxes(x, -1, -2)))
