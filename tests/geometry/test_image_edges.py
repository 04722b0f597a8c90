"""Edge maps against their plain form, and what must not be an edge."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry.image_edges import (
    BLUR_SIGMA_PX,
    CLIP_SHARE,
    FLOOR_SHARE,
    MEAN_RADIUS_PX,
    edge_pyramid,
    halved,
)
from oracles import gaussian_blur, local_mean, sobel_magnitude, standardised_over

HEIGHT, WIDTH = 61, 84
CUT_PX = 7
"""Where the Gaussian is cut off: three and a half sigmas."""


def picture(seed: int) -> NDArray[np.uint8]:
    """Boxes of random grey on a ramp, with noise."""
    rng = np.random.default_rng(seed)
    grey = np.tile(np.linspace(40, 120, WIDTH), (HEIGHT, 1)) + rng.normal(scale=3.0, size=(HEIGHT, WIDTH))
    for _ in range(12):
        y, x = rng.integers(0, HEIGHT - 10), rng.integers(0, WIDTH - 10)
        grey[y : y + rng.integers(4, 25), x : x + rng.integers(4, 25)] += rng.uniform(-80, 80)
    return np.clip(grey, 0, 255).astype(np.uint8)


def disc() -> NDArray[np.bool_]:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.asarray(np.hypot(y - 30, x - 40) < 27)


def box() -> NDArray[np.bool_]:
    """All but the part of the picture where the bonnet is."""
    lit = np.ones((HEIGHT, WIDTH), np.bool_)
    lit[40:, 20:60] = False
    return lit


ALL = np.ones((HEIGHT, WIDTH), np.bool_)


def by_oracle(grey: NDArray[np.uint8], level: int) -> NDArray[np.float64]:
    gradient = sobel_magnitude(grey)
    gradient = np.minimum(gradient, np.quantile(gradient[gradient > 0.0], CLIP_SHARE))
    mean = local_mean(gradient, MEAN_RADIUS_PX)
    edges = gradient / (mean + FLOOR_SHARE * mean.mean())
    for _ in range(level):
        h, w = edges.shape[0] // 2, edges.shape[1] // 2
        edges = edges[: 2 * h, : 2 * w].reshape(h, 2, w, 2).mean(axis=(1, 3))
    return standardised_over(gaussian_blur(edges, BLUR_SIGMA_PX, CUT_PX), np.ones(edges.shape, np.bool_))


@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_level_agrees_with_the_plain_form(level: int) -> None:
    grey = picture(0)
    levels = edge_pyramid(grey, ALL, 3).levels
    assert levels[level].shape == (HEIGHT >> level, WIDTH >> level)
    np.testing.assert_allclose(levels[level], by_oracle(grey, level), atol=2e-4)


@pytest.mark.parametrize("lit", [ALL, disc(), box()], ids=["all", "disc", "box"])
def test_levels_are_standardised_where_pixels_count_and_void_elsewhere(lit: NDArray[np.bool_]) -> None:
    first, *_ = levels = edge_pyramid(picture(1), lit, 3).levels
    assert (np.isfinite(first) == lit).all()
    for level in levels:
        counted = level[np.isfinite(level)]
        assert counted.mean() == pytest.approx(0.0, abs=1e-4)
        assert counted.std() == pytest.approx(1.0, abs=1e-4)


def test_a_coarse_pixel_counts_only_if_all_four_below_it_do() -> None:
    lit = disc()
    fine, coarse = edge_pyramid(picture(1), lit, 2).levels
    h, w = coarse.shape
    assert (np.isfinite(coarse) == np.isfinite(fine)[: 2 * h, : 2 * w].reshape(h, 2, w, 2).all(axis=(1, 3))).all()


@pytest.mark.parametrize("lit", [disc(), box()], ids=["disc", "box"])
def test_the_border_of_a_mask_is_no_edge(lit: NDArray[np.bool_]) -> None:
    """A uniform picture with a black rim has no edges at all."""
    for level in edge_pyramid(np.where(lit, 120, 0).astype(np.uint8), lit, 3).levels:
        assert (level[np.isfinite(level)] == 0.0).all()


@pytest.mark.parametrize("lit", [disc(), box()], ids=["disc", "box"])
def test_what_a_mask_hides_does_not_matter(lit: NDArray[np.bool_]) -> None:
    grey = picture(2)
    hidden = np.where(lit, grey, picture(3))
    for a, b in zip(edge_pyramid(grey, lit, 3).levels, edge_pyramid(hidden, lit, 3).levels, strict=True):
        np.testing.assert_array_equal(a, b)


def stripes(width: int, period_px: int = 10, step: int = 100) -> NDArray[np.uint8]:
    """Upright bars of grey 60 and 60 + step."""
    bars = (np.arange(width) // (period_px // 2)) % 2
    return np.tile(60 + step * bars, (HEIGHT, 1)).astype(np.uint8)


def test_opposite_borders_of_a_picture_are_not_neighbours() -> None:
    """A mask at the bottom leaves the top as it is, next to the border of the picture or not."""
    touching, apart = ALL.copy(), ALL.copy()
    touching[-8:], apart[-12:-4] = False, False
    a, b = (edge_pyramid(stripes(WIDTH), lit, 1).levels[0] for lit in (touching, apart))
    # All rows above look the same but the first, which has no gradient: the reach of its shadow tells where it is.
    assert shadow(a) == pytest.approx(shadow(b), rel=0.03)


def shadow(level: NDArray[np.float32]) -> float:
    """How much the fourth row falls short of the middle, as a share of the first row's shortfall."""
    rows = level[:24].mean(axis=1)
    return float((rows[20] - rows[3]) / (rows[20] - rows[0]))


def test_a_uniform_picture_has_no_edges() -> None:
    for level in edge_pyramid(np.full((HEIGHT, WIDTH), 90, np.uint8), ALL, 3).levels:
        assert (level == 0.0).all()


def test_a_picture_that_is_masked_whole_has_no_values() -> None:
    for level in edge_pyramid(picture(0), ~ALL, 3).levels:
        assert np.isnan(level).all()


def test_contrast_and_brightness_do_not_matter() -> None:
    grey = picture(4) // 3
    plain, bright = edge_pyramid(grey, ALL, 3), edge_pyramid(grey * 2 + 20, ALL, 3)
    for a, b in zip(plain.levels, bright.levels, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-3)


def test_weak_edges_far_from_strong_ones_count_as_much() -> None:
    """The local mean lifts steps of twenty grey values towards the height of those of a hundred."""
    grey = np.hstack([stripes(200), stripes(200, step=20)])
    level = edge_pyramid(grey, np.ones(grey.shape, np.bool_), 1).levels[0]
    strong, weak = level[30, 30:170].mean(), level[30, 230:370].mean()
    # Of gradients alone, strong edges would lie 2 standard deviations above weak ones.
    assert strong - weak < 1.5


def test_halving_takes_the_mean_of_four_and_leaves_out_the_odd() -> None:
    values = np.arange(15, dtype=np.float32).reshape(3, 5)
    assert halved(values).tolist() == [[3.0, 5.0]]
