"""Stacks of small matrices, element by element, against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest

from coec.geometry import linalg


def _stack(n: int) -> np.ndarray:
    samples = np.random.default_rng(n).normal(size=(3, 4, n, n))
    return np.asarray(samples @ np.swapaxes(samples, -1, -2) + 0.1 * np.eye(n))


@pytest.mark.parametrize("n", [1, 6, 13])
def test_all_agree_with_lapack(n: int) -> None:
    a, right = _stack(n), np.random.default_rng(0).normal(size=(3, 4, n, 2))
    factor = linalg.cholesky(a)
    np.testing.assert_allclose(factor, np.linalg.cholesky(a), atol=1e-10)
    np.testing.assert_allclose(linalg.cholesky_solve(factor, right), np.linalg.solve(a, right), rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(linalg.log_determinant(factor), np.linalg.slogdet(a)[1], rtol=1e-10)
    np.testing.assert_allclose(linalg.inverse(a), np.linalg.inv(a), rtol=1e-6, atol=1e-7)
    x = right[..., 0]
    np.testing.assert_allclose(linalg.product(a, right), a @ right, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(linalg.squared(a, x), np.einsum("...i,...ij,...j->...", x, a, x), rtol=1e-10)


def test_one_that_is_not_positive_definite_is_refused() -> None:
    a = _stack(4)
    a[1, 2, 3, 3] = -1.0
    with pytest.raises(ValueError, match="pivot"):
        linalg.cholesky(a)
    a[1, 2, 3, 3] = np.nan
    with pytest.raises(ValueError, match="pivot"):
        linalg.cholesky(a)
