"""A paraboloid keeps its covariance; what is flatter than one is walked to its end."""

from __future__ import annotations

import numpy as np
import pytest

from coec.calibration.uncertainty.covariance import measure_noise, widened
from support.scenes import Array, landscape, paraboloids

SHAPE = (20, 16, 3)
TOP = 6e-4
"""Half the width of the hill on the table, radians: about one and a half standard deviations of its own."""


def maxima(rng: np.random.Generator) -> Array:
    samples = rng.normal(0.0, [5e-3, 1e-3, 1e-3], SHAPE)
    return np.asarray(samples - samples.mean(axis=(0, 1)))


def test_a_paraboloid_is_as_wide_as_its_top_says(rng: np.random.Generator) -> None:
    hill = landscape(paraboloids(np.diag([1.0, 4.0, 9.0]), maxima(rng)))
    noise = measure_noise(hill)
    assert noise is not None
    np.testing.assert_allclose(widened(hill, noise), noise.covariance, rtol=0.02, atol=1e-12)


@pytest.mark.parametrize("half_width", [0.01, 0.04])
def test_a_ridge_shows_as_a_ridge(half_width: float, rng: np.random.Generator) -> None:
    """Along the first axis a hill stands on a table: narrow at the top, and flat as far as the table goes."""
    hill = paraboloids(np.eye(3), maxima(rng))

    def table(xi: Array) -> Array:
        beyond = max(abs(xi[0]) - half_width, 0.0)
        on_table = xi.copy()
        on_table[0] = np.sign(xi[0]) * (min(abs(xi[0]), TOP) + beyond)
        return hill(on_table)

    flat = landscape(table, step_rad=3e-4)
    noise = measure_noise(flat)
    assert noise is not None
    wide = np.sqrt(np.diag(widened(flat, noise)))
    assert 5.0 * np.sqrt(noise.covariance[0][0]) < wide[0]
    assert half_width / 8.0 < wide[0] < half_width  # the walk doubles: it ends short of the edge by half at most
    assert (wide[1:] < 0.2 * wide[0]).all()


def test_what_lies_about_the_edge_of_certainty_counts_in_part(rng: np.random.Generator) -> None:
    """A table beside the hill, deeper and deeper: its width goes in steps of nothing that is seen."""
    hill = paraboloids(np.eye(3), maxima(rng))
    top = measure_noise(landscape(hill, step_rad=3e-4))
    assert top is not None
    sigma = float(np.sqrt(top.covariance[0][0]))

    def width(deep: float) -> float:
        def score(xi: Array) -> Array:
            fallen = xi.copy()
            fallen[0] = np.sign(xi[0]) * min(abs(xi[0]), deep * sigma)
            return hill(fallen)

        return float(np.sqrt(widened(landscape(score, step_rad=3e-4), top)[0][0]) / sigma)

    depths = np.arange(1.5, 4.5, 0.02)
    widths = np.array([width(float(deep)) for deep in depths])
    assert widths[0] > 8.0
    assert widths[-1] < 1.1
    assert (np.diff(widths) <= 1e-9).all()
    assert np.abs(np.diff(widths)).max() < 0.1 * widths[0]


def test_a_dent_in_a_ridge_takes_its_own_width_alone(rng: np.random.Generator) -> None:
    hill = paraboloids(np.eye(3), maxima(rng))
    top = measure_noise(landscape(hill, step_rad=3e-4))
    assert top is not None
    sigma = float(np.sqrt(top.covariance[0][0]))

    def with_dent(deep: float) -> float:
        def score(xi: Array) -> Array:
            away, fallen = abs(xi[0]) / sigma, xi.copy()
            fallen[0] = np.sign(xi[0]) * sigma * (deep if 7.0 < away < 9.0 else min(away, 1.5) + max(away - 60.0, 0.0))
            return hill(fallen)

        return float(np.sqrt(widened(landscape(score, step_rad=3e-4), top)[0][0]) / sigma)

    assert 0.6 * with_dent(1.5) < with_dent(5.0) < with_dent(1.5)
