"""Range edges as a linear function of parameters: value, gradient and cells against plain sums."""

from dataclasses import replace

import numpy as np
import pytest

from coec.geometry.compiler import on_one_thread
from coec.geometry.edges.displaced_alignment import DisplacedEdges, of_sums
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
        np.repeat(np.arange(len(COUNTS), dtype=np.int32), COUNTS),
        maps,
    )


def plain_significance(edges: DisplacedEdges, x: np.ndarray) -> float:
    strength = square = 0.0
    for k, frame in enumerate(edges.frame):
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
    inner = DisplacedEdges(edges.uv_px - still + 0.5, edges.jacobian, edges.weight, edges.frame, edges.maps)
    _, gradient = inner.significance(np.zeros(PARAMETERS))
    step = 0.02
    differences = [
        (inner.significance(step * unit)[0] - inner.significance(-step * unit)[0]) / (2.0 * step)
        for unit in np.eye(PARAMETERS)
    ]
    np.testing.assert_allclose(gradient, differences, rtol=1e-2, atol=1e-2)


def test_the_sums_of_cells_add_up_to_those_of_all(edges: DisplacedEdges, rng: np.random.Generator) -> None:
    cell, points = rng.integers(0, 6, len(edges.weight)), rng.normal(size=(3, PARAMETERS))
    cell[edges.frame == 0] = 0
    sums = edges.cell_sums(cell, 7, points, PARAMETERS)
    assert sums.shape == (3, 7, 2 + PARAMETERS)
    assert not sums[:, 6].any()
    z, gradients = of_sums(sums.sum(axis=1))
    expected = [edges.significance(x) for x in points]
    np.testing.assert_allclose(z, [value for value, _ in expected], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(gradients, [slope for _, slope in expected], rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(edges.cell_sums(cell, 7, points, 2), sums[:, :, :4])


def test_both_ends_of_differences_are_as_each_of_them(edges: DisplacedEdges, rng: np.random.Generator) -> None:
    centre, offsets = rng.normal(size=PARAMETERS), rng.normal(size=(5, PARAMETERS))
    values, gradients = edges.gradients_across(centre, offsets)
    for side, sign in enumerate((1.0, -1.0)):
        for k, offset in enumerate(offsets):
            value, slope = edges.significance(centre + sign * offset)
            assert values[side, k] == pytest.approx(value, rel=1e-3, abs=1e-3)
            np.testing.assert_allclose(gradients[side, k], slope, rtol=1e-2, atol=0.05)


def test_results_do_not_depend_on_the_number_of_threads(edges: DisplacedEdges, rng: np.random.Generator) -> None:
    many = replace(
        edges,
        uv_px=np.tile(edges.uv_px, 3),
        jacobian=np.tile(edges.jacobian, 3),
        weight=np.tile(edges.weight, 3),
        frame=np.tile(edges.frame, 3),
    )
    offsets = rng.normal(size=(5, PARAMETERS))
    values, gradients = many.gradients_across(offsets[0], offsets)
    with on_one_thread():
        alone, slopes = many.gradients_across(offsets[0], offsets)
    np.testing.assert_array_equal(values, alone)
    np.testing.assert_array_equal(gradients, slopes)


def test_where_nothing_is_in_view_there_is_no_significance(edges: DisplacedEdges) -> None:
    away = DisplacedEdges(edges.uv_px - 1e6, edges.jacobian, edges.weight, edges.frame, edges.maps)
    value, gradient = away.significance(np.zeros(PARAMETERS))
    assert value == 0.0
    assert not gradient.any()
