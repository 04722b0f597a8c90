"""Range edges as a linear function of parameters: value, gradient and cells against plain sums."""

import numpy as np
import pytest

from coec.geometry.edges.displaced_alignment import DisplacedEdges
from coec.geometry.edges.image_edges import STRENGTH_STEPS, VOID

COUNTS, WIDTH, HEIGHT, PARAMETERS = (400, 0, 250), 96, 64, 5


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def edges(rng: np.random.Generator) -> DisplacedEdges:
    """Some beside the image, and some on masked pixels."""
    count = sum(COUNTS)
    maps = rng.integers(-100, 100, (len(COUNTS), HEIGHT, WIDTH)).astype(np.int8)
    maps[:, 20:30, 40:50] = VOID
    return DisplacedEdges(
        rng.uniform([[-5.0], [-5.0]], [[WIDTH + 5.0], [HEIGHT + 5.0]], (2, count)).astype(np.float32),
        rng.normal(size=(PARAMETERS, 2, count)).astype(np.float32),
        rng.uniform(0.5, 2.0, count).astype(np.float32),
        np.cumsum([0, *COUNTS]).astype(np.int64),
        maps,
    )


def plain_significance(edges: DisplacedEdges, x: np.ndarray) -> float:
    strength = square = 0.0
    for frame, (first, last) in enumerate(zip(edges.first_point[:-1], edges.first_point[1:], strict=True)):
        for k in range(first, last):
            u, v = edges.uv_px[:, k].astype(float) + x @ edges.jacobian[:, :, k].astype(float)
            if not (0.0 <= u < WIDTH - 1 and 0.0 <= v < HEIGHT - 1):
                continue
            column, row = int(u), int(v)
            corners = edges.maps[frame, row : row + 2, column : column + 2].astype(float)
            if (corners == VOID).any():
                continue
            right, below = u - column, v - row
            value = np.array([1.0 - below, below]) @ corners @ np.array([1.0 - right, right])
            strength += float(edges.weight[k]) * value / STRENGTH_STEPS
            square += float(edges.weight[k]) ** 2
    return float(strength / np.sqrt(square))


def test_the_significance_is_that_of_plain_sums(edges: DisplacedEdges, rng: np.random.Generator) -> None:
    points = rng.normal(size=(4, PARAMETERS))
    expected = [plain_significance(edges, x) for x in points]
    assert [edges.significance(x)[0] for x in points] == pytest.approx(expected, rel=1e-3, abs=1e-3)
    np.testing.assert_allclose(edges.significances(points), [edges.significance(x)[0] for x in points], rtol=1e-6)


def test_the_gradient_is_that_of_differences(edges: DisplacedEdges) -> None:
    """Where no edge passes from one pixel to the next: a thousandth of a pixel about the centres of pixels."""
    still = edges.uv_px - np.floor(edges.uv_px)
    inner = DisplacedEdges(edges.uv_px - still + 0.5, edges.jacobian, edges.weight, edges.first_point, edges.maps)
    _, gradient = inner.significance(np.zeros(PARAMETERS))
    step = 0.02
    differences = [
        (inner.significance(step * unit)[0] - inner.significance(-step * unit)[0]) / (2.0 * step)
        for unit in np.eye(PARAMETERS)
    ]
    np.testing.assert_allclose(gradient, differences, rtol=1e-2, atol=1e-2)


def test_the_gradients_of_cells_add_up_to_that_of_all(edges: DisplacedEdges, rng: np.random.Generator) -> None:
    cell, x = rng.integers(0, 6, len(edges.weight)).astype(np.uint8), rng.normal(size=PARAMETERS)
    of_cells = edges.gradients_of_cells(cell, 6, x, PARAMETERS)
    assert of_cells.shape == (PARAMETERS, len(COUNTS), 6)
    assert not of_cells[:, 1].any()
    np.testing.assert_allclose(of_cells.sum(axis=(1, 2)), edges.significance(x)[1], rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(edges.gradients_of_cells(cell, 6, x, 2), of_cells[:2])


def test_many_points_are_as_each_of_them(edges: DisplacedEdges, rng: np.random.Generator) -> None:
    points = rng.normal(size=(5, PARAMETERS))
    values, gradients = edges.gradients_at(points)
    for point, value, gradient in zip(points, values, gradients, strict=True):
        alone, slope = edges.significance(point)
        assert alone == value
        np.testing.assert_array_equal(slope, gradient)


def test_other_coordinates_are_the_same_edges(edges: DisplacedEdges, rng: np.random.Generator) -> None:
    axes, x = rng.normal(size=(PARAMETERS, 3)), rng.normal(size=3)
    value, gradient = edges.along(axes).significance(x)
    expected, of_parameters = edges.significance(axes @ x)
    assert value == pytest.approx(expected, rel=1e-4, abs=1e-4)
    np.testing.assert_allclose(gradient, axes.T @ of_parameters, rtol=1e-3, atol=1e-2)


def test_where_nothing_is_in_view_there_is_no_significance(edges: DisplacedEdges) -> None:
    away = DisplacedEdges(edges.uv_px - 1e6, edges.jacobian, edges.weight, edges.first_point, edges.maps)
    value, gradient = away.significance(np.zeros(PARAMETERS))
    assert value == 0.0
    assert not gradient.any()
