"""Small linear algebra in plain floats: the last bit of a BLAS product may differ between two processes, and what is
decided or kept has to be the same to the byte."""

from __future__ import annotations

from collections.abc import Sequence
from math import fsum, sqrt


def solved(matrix: Sequence[Sequence[float]], right: Sequence[float]) -> list[float]:
    """The solution (n,) of a symmetric positive definite system (n, n), by its Cholesky factor.

    Raises:
        ValueError: the matrix is not positive definite.
    """
    n = len(right)
    factor = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = matrix[i][j] - fsum(factor[i][k] * factor[j][k] for k in range(j))
            if i == j and not rest > 0.0:
                raise ValueError(f"the matrix is not positive definite: its pivot {i} is {rest:.3g}")
            factor[i][j] = sqrt(rest) if i == j else rest / factor[j][j]
    forward: list[float] = []
    for i in range(n):
        forward.append((right[i] - fsum(factor[i][k] * forward[k] for k in range(i))) / factor[i][i])
    solution = [0.0] * n
    for i in reversed(range(n)):
        solution[i] = (forward[i] - fsum(factor[k][i] * solution[k] for k in range(i + 1, n))) / factor[i][i]
    return solution


def congruent(a: Sequence[Sequence[float]], m: Sequence[Sequence[float]]) -> list[list[float]]:
    """A·M·Aᵀ (r, r) of A (r, n) and M (n, n)."""
    inner = range(len(m))
    left = [[fsum(row[k] * m[k][j] for k in inner) for j in inner] for row in a]
    return [[fsum(of_left[k] * row[k] for k in inner) for row in a] for of_left in left]
