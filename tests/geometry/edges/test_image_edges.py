"""Edge maps against their plain form, what must not be an edge, and the layout that the bands must not see."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry.edges.image_edges import (
    BLUR_SIGMA_PX,
    CLIP_SHARE,
    FLOOR_SHARE,
    MEAN_RADIUS_PX,
    SHARP_SIGMA_PX,
    STRENGTH_STEPS,
    UPRIGHT_SHARE,
    VOID,
    EdgePyramid,
    EdgeScales,
    Rectangle,
    _less,
    halved,
)
from support.oracles import doubled, gaussian_blur, local_mean, sobel_magnitude, standardised_over

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

HALF_A_STEP = 0.5 / STRENGTH_STEPS + 5e-4
"""What rounding to whole steps may change, in standard deviations."""


SLANTED = np.array([0.28, 0.72])
"""Of a LiDAR whose axis slants, and points at the camera somewhat."""


def edge_pyramid(
    grey: NDArray[np.uint8], lit: NDArray[np.bool_], finest: int, coarsest: int, upright: NDArray[np.float64] = SLANTED
) -> EdgePyramid:
    return EdgeScales(lit, finest, coarsest, upright).pyramid(grey)


def strengths(level: NDArray[np.int8]) -> NDArray[np.float64]:
    """In standard deviations; NaN at masked pixels."""
    return np.where(level == VOID, np.nan, level / STRENGTH_STEPS)


def halved_plainly(values: NDArray[np.floating]) -> NDArray[np.float64]:
    h, w = values.shape[0] // 2, values.shape[1] // 2
    return np.asarray(values[: 2 * h, : 2 * w].reshape(h, 2, w, 2).mean(axis=(1, 3)))


def plain_edges(grey: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Gradients, clipped, over their local mean."""
    gradient = sobel_magnitude(grey, SLANTED, UPRIGHT_SHARE)
    gradient = np.minimum(gradient, np.quantile(gradient[gradient > 0.0], CLIP_SHARE))
    mean = local_mean(gradient, MEAN_RADIUS_PX)
    return np.asarray(gradient / (mean + FLOOR_SHARE * gradient.mean()))


def smooth_edges(grey: NDArray[np.uint8], lit: NDArray[np.bool_], levels: int) -> list[NDArray[np.float64]]:
    """Blurred edges of every level, by the plain forms; the mask must not hide any gradient."""
    edges, counted, smooth = plain_edges(grey), lit.astype(np.float64), []
    for _ in range(levels):
        share = gaussian_blur(counted, BLUR_SIGMA_PX, CUT_PX)
        smooth.append(gaussian_blur(edges * counted, BLUR_SIGMA_PX, CUT_PX) / np.maximum(share, 1e-3))
        edges, counted = halved_plainly(edges), np.floor(halved_plainly(counted))
    return smooth


def maps_of(pyramid: EdgePyramid) -> list[NDArray[np.float64]]:
    return [strengths(level) for level in (pyramid.sharp, pyramid.whole, *pyramid.bands)]


def most(expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Up to the strongest that a map can tell."""
    return np.clip(expected, -127 / STRENGTH_STEPS, 127 / STRENGTH_STEPS)


@pytest.mark.parametrize(("finest", "coarsest"), [(0, 2), (0, 0), (1, 2)])
def test_bands_are_what_a_level_has_and_the_next_does_not(finest: int, coarsest: int) -> None:
    grey = picture(0)
    smooth = smooth_edges(grey, ALL, coarsest + 2)
    pyramid = edge_pyramid(grey, ALL, finest, coarsest)
    assert len(pyramid.bands) == coarsest + 1 - finest
    for level, band in enumerate(pyramid.bands, start=finest):
        assert band.shape == (HEIGHT >> level, WIDTH >> level)
        expected = smooth[level] - doubled(smooth[level + 1], (HEIGHT >> level, WIDTH >> level))
        expected = most(standardised_over(expected, np.ones(band.shape, np.bool_)))
        np.testing.assert_allclose(strengths(band), expected, atol=HALF_A_STEP)
    half = halved_plainly(smooth[finest])
    whole = standardised_over(half, np.ones(half.shape, np.bool_))
    np.testing.assert_allclose(strengths(pyramid.whole), most(whole), atol=HALF_A_STEP)


def test_the_sharp_map_is_the_first_band_blurred_by_less_than_a_pixel() -> None:
    edges, taps = plain_edges(picture(0)), int(np.ceil(3.5 * SHARP_SIGMA_PX))
    wide = doubled(smooth_edges(picture(0), ALL, 2)[1], (HEIGHT, WIDTH))
    expected = standardised_over(gaussian_blur(edges, SHARP_SIGMA_PX, taps) - wide, ALL)
    sharp = edge_pyramid(picture(0), ALL, 0, 0).sharp
    np.testing.assert_allclose(strengths(sharp), most(expected), atol=HALF_A_STEP)


def test_a_level_does_not_depend_on_how_many_there_are() -> None:
    many, few = edge_pyramid(picture(0), box(), 0, 2), edge_pyramid(picture(0), box(), 1, 1)
    np.testing.assert_array_equal(many.bands[1], few.bands[0])


def test_under_a_mask_only_what_counts_is_blurred() -> None:
    """Strokes away from the mask: no gradient is hidden, yet the blur must not mix in the masked nothing."""
    lit, grey = ALL.copy(), np.full((HEIGHT, WIDTH), 90, np.uint8)
    lit[:, 50:] = False
    grey[5:50, [8, 20, 33, 43]] = 180
    smooth = smooth_edges(grey, lit, 2)
    pyramid = edge_pyramid(grey, lit, 0, 0)
    expected = standardised_over(smooth[0] - doubled(smooth[1], (HEIGHT, WIDTH)), lit)
    np.testing.assert_allclose(strengths(pyramid.bands[0]), most(expected), atol=HALF_A_STEP)


@pytest.mark.parametrize("shape", [(8, 10), (9, 11), (2, 3), (61, 84)])
def test_doubling_interpolates_between_the_pixels_of_the_half(shape: tuple[int, int]) -> None:
    values = np.random.default_rng(1).normal(size=(shape[0] // 2, shape[1] // 2)).astype(np.float32)
    np.testing.assert_allclose(_less(np.zeros(shape, np.float32), values), -doubled(values, shape), atol=1e-6)


def test_doubling_a_ramp_gives_the_ramp_back() -> None:
    """Away from the border nothing is shifted by half a pixel."""
    ramp = np.add.outer(np.arange(20.0), 3.0 * np.arange(30.0)).astype(np.float32)
    np.testing.assert_allclose(_less(ramp.copy(), halved(ramp))[1:-1, 1:-1], 0.0, atol=1e-5)


@pytest.mark.parametrize("lit", [ALL, disc(), box()], ids=["all", "disc", "box"])
def test_maps_are_standardised_where_pixels_count_and_void_elsewhere(lit: NDArray[np.bool_]) -> None:
    pyramid = edge_pyramid(picture(1), lit, 0, 1)
    assert ((pyramid.sharp != VOID) == lit).all()
    assert ((pyramid.bands[0] != VOID) == lit).all()
    for level in maps_of(pyramid):
        counted = level[np.isfinite(level)]
        assert counted.mean() == pytest.approx(0.0, abs=0.005)
        assert counted.std() == pytest.approx(1.0, abs=0.01)


def test_units_are_those_of_the_part_that_is_counted() -> None:
    part = Rectangle(8, 16, 40, 24)
    pyramid = EdgeScales(ALL, 0, 1, SLANTED, part).pyramid(picture(1))
    for level, maps in ((0, pyramid.sharp), (0, pyramid.bands[0]), (1, pyramid.whole), (1, pyramid.bands[1])):
        counted = strengths(maps)[part.halved(level).slices]
        assert counted.mean() == pytest.approx(0.0, abs=0.01)
        assert counted.std() == pytest.approx(1.0, abs=0.02)


def test_a_coarse_pixel_counts_only_if_all_four_below_it_do() -> None:
    fine, coarse = edge_pyramid(picture(1), disc(), 0, 1).bands
    expected = halved_plainly((fine != VOID).astype(float)) == 1.0
    assert ((coarse != VOID) == expected).all()


def crowded(height: int = 240, width: int = 320) -> NDArray[np.uint8]:
    """Short strokes everywhere, four times as many at the bottom as at the top."""
    rng = np.random.default_rng(8)
    grey = np.full((height, width), 90, np.uint8)
    rows = height * np.sqrt(rng.uniform(0.05, 1.0, 1500))
    for y, x in zip(rows.astype(int), rng.integers(0, width - 6, 1500), strict=True):
        grey[y, x : x + 6] = 170
    return grey


def tilt(level: NDArray[np.int8]) -> float:
    """How far the lower half stands above the upper one, in standard deviations of the map."""
    middle, strength = len(level) // 2, strengths(level)
    return float(strength[middle:].mean() - strength[:middle].mean())


def test_layout_that_is_wider_than_its_blur_leaves_no_trace_in_a_band() -> None:
    grey = crowded()
    pyramid = edge_pyramid(grey, np.ones(grey.shape, np.bool_), 0, 1)
    assert tilt(pyramid.whole) > 0.25
    assert max(abs(tilt(band)) for band in (pyramid.sharp, *pyramid.bands)) < 0.05


def test_a_band_peaks_on_an_edge_and_is_below_zero_next_to_it() -> None:
    grey = np.full((HEIGHT, WIDTH), 90, np.uint8)
    grey[:, 40:] = 170
    (band,) = edge_pyramid(grey, ALL, 0, 0).bands
    across = strengths(band)[10:50].mean(axis=0)
    assert np.argmax(across) in (39, 40)
    assert across[[32, 47]].max() < min(0.0, across[:20].max() + 1e-6)


@pytest.mark.parametrize("lit", [disc(), box()], ids=["disc", "box"])
def test_the_border_of_a_mask_is_no_edge(lit: NDArray[np.bool_]) -> None:
    """A uniform picture with a black rim has no edges at all."""
    for level in maps_of(edge_pyramid(np.where(lit, 120, 0).astype(np.uint8), lit, 0, 1)):
        assert (level[np.isfinite(level)] == 0.0).all()


@pytest.mark.parametrize("lit", [disc(), box()], ids=["disc", "box"])
def test_what_a_mask_hides_does_not_matter(lit: NDArray[np.bool_]) -> None:
    grey = picture(2)
    hidden = np.where(lit, grey, picture(3))
    for a, b in zip(maps_of(edge_pyramid(grey, lit, 0, 1)), maps_of(edge_pyramid(hidden, lit, 0, 1)), strict=True):
        np.testing.assert_array_equal(a, b)


def stripes(width: int, period_px: int = 10, step: int = 100) -> NDArray[np.uint8]:
    """Upright bars of grey 60 and 60 + step."""
    bars = (np.arange(width) // (period_px // 2)) % 2
    return np.tile(60 + step * bars, (HEIGHT, 1)).astype(np.uint8)


def test_opposite_borders_of_a_picture_are_not_neighbours() -> None:
    """A mask at the bottom leaves the top as it is, next to the border of the picture or not."""
    touching, separation = ALL.copy(), ALL.copy()
    touching[-8:], separation[-12:-4] = False, False
    a, b = (edge_pyramid(stripes(WIDTH), lit, 0, 0).whole for lit in (touching, separation))
    # All rows above look the same but the first, which has no gradient: the reach of its shadow tells where it is.
    assert shadow(a) == pytest.approx(shadow(b), rel=0.03)


def shadow(level: NDArray[np.int8]) -> float:
    """How much the second row of the map falls short of the eleventh, as a share of the first row's shortfall."""
    rows = strengths(level)[:12].mean(axis=1)
    return float((rows[10] - rows[1]) / (rows[10] - rows[0]))


def test_edges_that_cross_the_scan_lines_stand_above_those_along_them() -> None:
    """Sides and tops of equally bright boxes. Where the camera looks along the axis, no direction is special."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    grey = np.where((y // 12 + x // 12) % 2 == 1, 170, 90).astype(np.uint8)

    def strength_of(upright: NDArray[np.float64]) -> tuple[float, float]:
        level = strengths(edge_pyramid(grey, ALL, 0, 0, upright).sharp)
        return float(level[30, 34:38].max()), float(level[34:38, 30].max())

    side, top = strength_of(np.array([0.0, -1.0]))
    assert side > 1.15 * top > 0.0
    lying_side, lying_top = strength_of(np.array([1.0, 0.0]))
    assert lying_top > 1.15 * lying_side > 0.0
    even_side, even_top = strength_of(np.zeros(2))
    assert even_side == pytest.approx(even_top, rel=0.05)


def test_a_uniform_picture_has_no_edges() -> None:
    for level in maps_of(edge_pyramid(np.full((HEIGHT, WIDTH), 90, np.uint8), ALL, 0, 1)):
        assert (level == 0.0).all()


def test_a_picture_that_is_masked_whole_has_no_values() -> None:
    for level in maps_of(edge_pyramid(picture(0), ~ALL, 0, 1)):
        assert np.isnan(level).all()


def test_contrast_and_brightness_do_not_matter() -> None:
    grey = picture(4) // 3
    plain, bright = edge_pyramid(grey, ALL, 0, 1), edge_pyramid(grey * 2 + 20, ALL, 0, 1)
    for a, b in zip(maps_of(plain), maps_of(bright), strict=True):
        np.testing.assert_allclose(a, b, atol=1.01 / STRENGTH_STEPS)


def test_weak_edges_far_from_strong_ones_count_as_much() -> None:
    """The local mean lifts steps of twenty grey values towards the height of those of a hundred."""
    grey = np.hstack([stripes(200), stripes(200, step=20)])
    level = strengths(edge_pyramid(grey, np.ones(grey.shape, np.bool_), 0, 0).whole)
    strong, weak = level[15, 15:85].mean(), level[15, 115:185].mean()
    # Of gradients alone, strong edges would lie 2 standard deviations above weak ones.
    assert strong - weak < 1.5


def test_halving_takes_the_mean_of_four_and_leaves_out_the_odd() -> None:
    values = np.arange(15, dtype=np.float32).reshape(3, 5)
    assert halved(values).tolist() == [[3.0, 5.0]]
