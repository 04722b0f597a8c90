"""Planes through neighbours, beside NumPy's."""

import numpy as np

from coec.geometry.sweep_kernels import planes_through


def test_planes_are_those_of_a_singular_value_decomposition() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, 12, 3)) * rng.uniform(0.01, 1.0, size=(40, 1, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(40, 3, 3)))
    points = np.einsum("nij,nkj->nki", turn, points) + 5.0
    neighbours = np.arange(40 * 12).reshape(40, 12)
    planes = planes_through(points.reshape(-1, 3), neighbours, np.zeros((40, 12)), 1.0)
    for i in range(40):
        centred = points[i] - points[i].mean(axis=0)
        _, size, axes = np.linalg.svd(centred)
        np.testing.assert_allclose(planes.centre[i], points[i].mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(planes.spread[i], size[::-1] / np.sqrt(12), rtol=1e-7, atol=1e-9)
        assert abs(planes.normal[i] @ axes[2]) > 1 - 1e-9
        assert abs(planes.axes[i, 1] @ axes[0]) > 1 - 1e-9
        assert abs(planes.axes[i, 0] @ planes.normal[i]) < 1e-9


def test_neighbours_out_of_reach_do_not_count_and_two_make_no_plane() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 50]])
    everything = np.array([[0, 1, 2, 3]])
    near = planes_through(points, everything, np.array([[0.0, 1, 1, 2500]]), 2.0)
    assert near.used[0] == 3
    np.testing.assert_allclose(np.abs(near.normal[0]), [0, 0, 1], atol=1e-12)
    assert near.spread[0, 0] < 1e-12
    few = planes_through(points, everything, np.array([[0.0, 1, 2500, 2500]]), 2.0)
    assert few.used[0] == 2
    assert np.isnan(few.spread[0]).all()
