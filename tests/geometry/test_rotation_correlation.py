"""Correlation over rotations: the sum over points at each rotation, one by one."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry.rotation_correlation import RotationGrid, local_maxima

BANDWIDTH = 16


Hills = tuple[NDArray[np.float64], NDArray[np.float64]]


def bumps(rng: np.random.Generator) -> Hills:
    """Centres (3, 3) and weights (3,) of three smooth hills on a sphere."""
    centres = rng.normal(size=(3, 3))
    return centres / np.linalg.norm(centres, axis=1, keepdims=True), rng.uniform(0.5, 2.0, 3)


def height(
    hills: tuple[NDArray[np.float64], NDArray[np.float64]], directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    centres, weights = hills
    return np.asarray(np.exp(8.0 * (directions @ centres.T - 1.0)) @ weights)


@pytest.mark.parametrize("signals", [1, 2])
def test_the_correlation_is_the_sum_over_the_points_at_every_rotation(signals: int) -> None:
    rng, grid = np.random.default_rng(3), RotationGrid(BANDWIDTH)
    cells, rows = len(grid.directions), range(signals)
    hills = [bumps(rng) for _ in rows]
    points = [rng.integers(0, cells, 60) for _ in rows]
    weights = [rng.uniform(0.5, 1.5, 60) for _ in rows]
    of_camera = grid.harmonics(np.array([height(hills[k], grid.directions) * grid.solid_angles for k in rows]))
    of_lidar = grid.harmonics(np.array([np.bincount(points[k], weights[k], cells) for k in rows]))
    correlation = grid.correlation(of_camera, of_lidar)
    places = rng.integers(0, correlation.size, 20)
    for rotation, value in zip(grid.rotations(places), correlation.ravel()[places], strict=True):
        assert np.allclose(rotation @ rotation.T, np.eye(3))
        expected = sum(float(weights[k] @ height(hills[k], grid.directions[points[k]] @ rotation.T)) for k in rows)
        assert value == pytest.approx(expected, rel=2e-3)


def test_a_point_lies_in_the_cell_in_whose_direction_it_is() -> None:
    grid, rng = RotationGrid(BANDWIDTH), np.random.default_rng(4)
    xyz = rng.normal(size=(500, 3)) * 10.0
    seen = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    separation_rad = np.arccos(np.clip(np.sum(seen * grid.directions[grid.cells(xyz)], axis=1), -1.0, 1.0))
    assert separation_rad.max() < np.pi / BANDWIDTH / 2.0
    assert grid.solid_angles.sum() == pytest.approx(4.0 * np.pi, rel=1e-2)


def test_local_maxima_are_those_of_a_plain_search() -> None:
    scores = np.random.default_rng(5).random((5, 6, 6)).astype(np.float32)
    around = [(0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    expected = []
    for place in np.ndindex(scores.shape):
        row, a, g = place
        neighbours = [scores[row, (a + da) % 6, (g + dg) % 6] for _, da, dg in around]
        neighbours += [scores[other, a, g] for other in (row - 1, row + 1) if 0 <= other < 5]
        if scores[place] > 0.5 and scores[place] >= max(neighbours):
            expected.append(int(np.ravel_multi_index(place, scores.shape)))
    assert local_maxima(scores, 0.5).tolist() == expected
    assert local_maxima(scores, 2.0).tolist() == []
