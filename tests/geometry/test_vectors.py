"""Arrays of vectors."""

from __future__ import annotations

import numpy as np

from coec.geometry.points import lengths, random_direction


def test_lengths_are_those_of_numpy_to_the_bit() -> None:
    vectors = np.random.default_rng(0).normal(size=(1000, 3))
    np.testing.assert_array_equal(lengths(vectors), np.linalg.norm(vectors, axis=1))


def test_directions_are_unit_vectors_all_around() -> None:
    rng = np.random.default_rng(1)
    samples = np.array([random_direction(rng) for _ in range(4000)])
    np.testing.assert_allclose(lengths(samples), 1.0)
    octants = np.bincount((samples > 0.0) @ [1, 2, 4], minlength=8)
    assert np.abs(octants / 4000 - 1 / 8).max() < 0.03
