"""Small dense linear algebra without BLAS and LAPACK, on lists of plain floats and on stacks of matrices. The last bit
of a product of BLAS may differ between two processes, and decisions and stored results have to be the same to the
bit.

`linear` does the same for one matrix in plain floats. Here all matrices of a stack go through each step together, which
is fast enough for some thousand of them, or for one with a hundred rows.
"""

from collections.abc import Sequence
from math import copysign, fsum, hypot, sqrt

import numpy as np
from numpy.typing import NDArray

Rows = Sequence[Sequence[float]]

MAX_SWEEPS = 30
"""Most sweeps of rotations in `eigen`; a 6×6 matrix takes five or six."""


def solved(matrix: Rows, right: Sequence[float]) -> list[float]:
    """The solution (n,) of a symmetric positive definite system (n, n), by its Cholesky factor.

    Raises:
        ValueError: the matrix is not positive definite.
    """
    return _solved(_cholesky(matrix), right)


def inverted(matrix: Rows) -> list[list[float]]:
    """The inverse (n, n) of a symmetric positive definite matrix (n, n).

    Raises:
        ValueError: the matrix is not positive definite.
    """
    factor, n = _cholesky(matrix), len(matrix)
    # The inverse is symmetric: its columns are its rows.
    return [_solved(factor, [float(row == column) for row in range(n)]) for column in range(n)]


def congruent(a: Rows, m: Rows) -> list[list[float]]:
    """A·M·Aᵀ (r, r) of A (r, n) and M (n, n)."""
    inner = range(len(m))
    left = [[fsum(row[k] * m[k][j] for k in inner) for j in inner] for row in a]
    return [[fsum(of_left[k] * row[k] for k in inner) for row in a] for of_left in left]


def eigen(matrix: Rows) -> list[tuple[float, list[float]]]:
    """Eigenvalues of a symmetric matrix (n, n), the largest first, each with its unit vector (n,).

    Jacobi's rotations, row by row (Golub, Van Loan 2013, section 8.5).
    """
    n = len(matrix)
    a = [[float(value) for value in row] for row in matrix]
    vectors = [[float(i == j) for j in range(n)] for i in range(n)]
    for _ in range(MAX_SWEEPS):
        off_diagonal = fsum(abs(a[i][j]) for i in range(n) for j in range(i))
        if off_diagonal <= 1e-15 * fsum(abs(a[i][i]) for i in range(n)):
            break
        for p in range(n):
            for q in range(p + 1, n):
                if a[p][q] != 0.0:
                    _rotate(a, vectors, p, q)
    pairs = [(a[k][k], [row[k] for row in vectors]) for k in range(n)]
    return sorted(pairs, key=lambda pair: -pair[0])


def _rotate(a: list[list[float]], vectors: list[list[float]], p: int, q: int) -> None:
    """Jacobi rotation in place: turns the plane of axes p and q so that `a[p][q]` becomes zero."""
    tau = (a[q][q] - a[p][p]) / (2.0 * a[p][q])
    tangent = copysign(1.0, tau) / (abs(tau) + hypot(1.0, tau))
    cosine = 1.0 / hypot(1.0, tangent)
    sine = tangent * cosine
    for row in (*a, *vectors):
        row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]
    for k in range(len(a)):
        a[p][k], a[q][k] = cosine * a[p][k] - sine * a[q][k], sine * a[p][k] + cosine * a[q][k]
    a[p][q] = a[q][p] = 0.0


def _cholesky(matrix: Rows) -> list[list[float]]:
    """L (n, n) of the matrix L·Lᵀ, zeros above the diagonal."""
    n = len(matrix)
    factor = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = matrix[i][j] - fsum(factor[i][k] * factor[j][k] for k in range(j))
            if i == j and not rest > 0.0:
                raise ValueError(f"the matrix is not positive definite: its pivot {i} is {rest:.3g}")
            factor[i][j] = sqrt(rest) if i == j else rest / factor[j][j]
    return factor


def _solved(factor: Rows, right: Sequence[float]) -> list[float]:
    """The solution of L·Lᵀ·x = right, by forward and backward substitution."""
    n = len(right)
    forward: list[float] = []
    for i in range(n):
        forward.append((right[i] - fsum(factor[i][k] * forward[k] for k in range(i))) / factor[i][i])
    solution = [0.0] * n
    for i in reversed(range(n)):
        solution[i] = (forward[i] - fsum(factor[k][i] * solution[k] for k in range(i + 1, n))) / factor[i][i]
    return solution


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
