"""The sandwich covers what chance does, when frames differ and when only sectors do; and how many looks there were."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from coec.calibration.objective.landscape import scatter
from coec.calibration.uncertainty.covariance import measure_noise
from support.scenes import Array, landscape, paraboloids

FRAMES, SECTORS = 20, 16
SPREAD = 1e-3
"""Of the maximum of a cell, radians."""


def moving(rng: np.random.Generator) -> Array:
    """(F, B, 3): every frame shows other things."""
    return rng.normal(0.0, SPREAD, (FRAMES, SECTORS, 3))


def standing(rng: np.random.Generator) -> Array:
    """Every frame shows the same things, but for the noise of the sensors."""
    things = rng.normal(0.0, SPREAD, (1, SECTORS, 3))
    return np.asarray(things + rng.normal(0.0, 0.1 * SPREAD, (FRAMES, SECTORS, 3)))


def square_of(rng: np.random.Generator) -> Array:
    root = rng.normal(size=(3, 3))
    return root @ root.T + np.eye(3)


@pytest.mark.parametrize("rendered", [moving, standing])
def test_three_sigma_cover_whether_the_vehicle_drives_or_stands(
    rendered: Callable[[np.random.Generator], Array], rng: np.random.Generator
) -> None:
    """The truth is at zero; the optimum is the mean of the cells' maxima."""
    square, normalised = square_of(rng), []
    for _ in range(60):
        maxima = rendered(rng)
        optimum = maxima.mean(axis=(0, 1))
        noise = measure_noise(landscape(paraboloids(square, maxima - optimum)))
        assert noise is not None
        normalised.append(optimum / np.sqrt(np.diag(noise.covariance)))
    spread = np.sqrt(np.mean(np.square(normalised), axis=0))
    assert (np.abs(normalised) < 3.0).mean() >= 0.97
    assert ((spread > 0.4) & (spread < 1.1)).all()


def test_observations_are_the_frames_of_a_drive_and_one_of_a_standing_vehicle(rng: np.random.Generator) -> None:
    square = square_of(rng)

    def observations(maxima: Array) -> float:
        noise = measure_noise(landscape(paraboloids(square, maxima - maxima.mean(axis=(0, 1)))))
        assert noise is not None
        return noise.independent_samples

    assert observations(moving(rng)) > 0.6 * FRAMES
    assert observations(standing(rng)) < 1.5
    half = np.concatenate([standing(rng)[: FRAMES // 2], moving(rng)[: FRAMES // 2]])
    assert 1.5 < observations(half) < 0.6 * FRAMES


def test_the_scatter_of_sums_is_that_of_their_frames_and_of_their_sectors(rng: np.random.Generator) -> None:
    cells = rng.normal(size=(2, 5, 4))
    expected = sum(
        groups.shape[1] ** 2 / (groups.shape[1] - 1) * np.cov(groups, ddof=0)
        for groups in (cells.sum(axis=2), cells.sum(axis=1))
    )
    np.testing.assert_allclose(scatter(cells), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("square", "frames"), [(np.diag([1.0, -1.0, 1.0]), FRAMES), (np.eye(3), 3), (np.zeros((3, 3)), FRAMES)],
    ids=["saddle", "fewer frames than it takes", "flat"],
)  # fmt: skip
def test_without_a_maximum_or_with_too_few_frames_nothing_is_known(
    square: Array, frames: int, rng: np.random.Generator
) -> None:
    assert measure_noise(landscape(paraboloids(square, moving(rng)[:frames]))) is None


@pytest.mark.fault("frames that repeat one another", "they give no certainty, and no number ends the service")
@pytest.mark.parametrize(("views", "axes"), [(1, 3), (2, 3), (3, 3), (5, 6)])
def test_views_that_come_again_settle_no_more_axes_than_they_are(
    views: int, axes: int, rng: np.random.Generator
) -> None:
    """In one sector, as an objective without sectors has it; so many views differ along one axis less."""
    seen = rng.normal(0.0, SPREAD, (views, 1, axes))
    repeated = np.tile(seen, (FRAMES // views, 1, 1))
    centred = repeated - repeated.mean(axis=(0, 1))
    assert measure_noise(landscape(paraboloids(np.eye(axes), centred), axes)) is None
    one_more = centred + rng.normal(0.0, 0.01 * SPREAD, centred.shape)
    assert measure_noise(landscape(paraboloids(np.eye(axes), one_more), axes)) is not None


def test_a_dent_at_the_top_of_a_hill_is_passed_over(rng: np.random.Generator) -> None:
    """A ripple as narrow as the first step makes the top a saddle; the hill is told all the same."""
    hill = paraboloids(np.eye(3), moving(rng))

    def dented(xi: Array) -> Array:
        return np.asarray(hill(xi) - 1e-6 * np.exp(-0.5 * (xi[1] / 4e-4) ** 2) / FRAMES)

    whole, with_dent = measure_noise(landscape(hill)), measure_noise(landscape(dented))
    assert whole is not None
    assert with_dent is not None
    np.testing.assert_allclose(with_dent.covariance, whole.covariance, rtol=0.3, atol=1e-9)
