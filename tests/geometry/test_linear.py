"""Plain linear algebra against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from coec.geometry.linalg import congruent, eigen, inverted, solved


@pytest.mark.parametrize("size", [1, 3, 6, 7])
def test_systems_inverses_and_congruences_are_those_of_numpy(size: int) -> None:
    rng = np.random.default_rng(size)
    root, other, right = rng.normal(size=(size, size)), rng.normal(size=(4, size)), rng.normal(size=size)
    matrix = root @ root.T + 0.1 * np.eye(size)
    np.testing.assert_allclose(solved(matrix.tolist(), right.tolist()), np.linalg.solve(matrix, right), rtol=1e-8)
    np.testing.assert_allclose(inverted(matrix.tolist()), np.linalg.inv(matrix), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(congruent(other.tolist(), matrix.tolist()), other @ matrix @ other.T, atol=1e-9)


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_eigenvectors_are_those_of_numpy_but_for_their_sign(size: int) -> None:
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size))
    matrix = root + root.T
    pairs = eigen(matrix.tolist())
    values, vectors = np.array([value for value, _ in pairs]), np.array([vector for _, vector in pairs]).T
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix)[::-1], atol=1e-12)
    np.testing.assert_allclose(matrix @ vectors, vectors * values, atol=1e-12)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(size), atol=1e-12)


@pytest.mark.parametrize("matrix", [[[0.0]], [[1.0, 0.0], [0.0, -1.0]], [[1.0, 2.0], [2.0, 1.0]], [[float("nan")]]])
def test_what_is_not_positive_definite_is_refused(matrix: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="not positive definite"):
        inverted(matrix)
    with pytest.raises(ValueError, match="not positive definite"):
        solved(matrix, [1.0] * len(matrix))
