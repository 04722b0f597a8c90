"""The nearest points, beside every distance."""

import numpy as np
import pytest

pytest.importorskip("small_gicp", reason="needs the optional extra `lidars`")

from coec.calibration.rig.nearest_neighbours import KdTree


def test_the_nearest_are_those_of_all_distances_and_the_same_again() -> None:
    rng = np.random.default_rng(3)
    points, queries = rng.normal(size=(500, 3)), rng.normal(size=(40, 3))
    result, squared = KdTree(points).nearest(queries, 5)
    separation = ((points[None] - queries[:, None]) ** 2).sum(axis=2)
    np.testing.assert_array_equal(result, np.argsort(separation, axis=1)[:, :5])
    np.testing.assert_allclose(squared, np.sort(separation, axis=1)[:, :5], rtol=1e-12)
    again = KdTree(points).nearest(queries, 5)
    assert np.array_equal(result, again[0])
    assert np.array_equal(squared, again[1])


def test_no_query_has_no_answer() -> None:
    result, squared = KdTree(np.eye(3)).nearest(np.empty((0, 3)), 2)
    assert result.shape == squared.shape == (0, 2)
