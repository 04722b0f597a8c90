"""Edge strength at every pixel, at several scales: the maps onto which range edges are laid.

It is the gradient magnitude, reduced along the axis of the LiDAR, clipped, and divided by its local mean (so that a
hedge does not outweigh a house). Of that, the maps are the bands of a Laplacian pyramid (Burt, Adelson 1983): each
level blurred by two pixels, minus the next level. What is wider than a level's blur is the layout of the scene, with
many edges below the horizon and few above, which fits many wrong poses. Without the layout the true pose stands at
least twice as far from the others. See docs/measured.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.points import thinned

CLIP_SHARE = 0.95
"""Gradients are clipped at this quantile, as reflections and lamps would outweigh the rest."""

UPRIGHT_SHARE = math.sqrt(0.5)
"""Share of a gradient along the axis of the LiDAR that counts: half of its energy. Range jumps are found along scan
lines, so that the edges that cause them cross those lines. The share is not smaller, because slanting roofs and kerbs
determine pitch, roll and height, and slow traffic under a bridge shows mostly such edges. See docs/measured.md."""

SAMPLES = 25_000
"""Pixels of an image from which the quantile of `CLIP_SHARE` (without flat ones) and the mean gradient are taken."""

MEAN_RADIUS_PX = 20
"""The local mean is over a square of 41 px (METHOD: 40 px)."""

FLOOR_SHARE = 0.25
"""Added to the local mean, as a share of the mean of the whole image, so that noise in flat regions is not amplified to
edges."""

BLUR_ROWS = 32
"""Rows that are blurred at a time: with the rows around them they stay in the cache between the two directions."""

STRIP_ROWS = 128
"""Rows of a strip within which local means are carried from row to row; three times the rows that a mean spans."""

GAIN_SQUARE_PX = 16
"""Side of the squares in which a mask is examined; more than the reach of a blur."""

LEAST_SHARE = 1e-3
"""Least total weight, under a blur, of the pixels that count; a bound for places where hardly any counts."""

STRENGTH_STEPS = 16
"""Whole steps of edge strength per standard deviation. A byte holds eight deviations; a few edges in a million are
stronger. Rounding adds to the strength of one edge a fiftieth of the spread of strengths."""

VOID = np.int8(-128)
"""Stands for a pixel that is masked."""

BLUR_SIGMA_PX = 2.0
"""Blur of each level, in pixels of that level: 2, 4, 8 ... pixels of the image."""

SHARP_SIGMA_PX = 0.6
"""Blur of the sharpest map, px. Structure beside an edge draws a blurred edge towards itself, above all the road below
a kerb. Structure narrower than 2 px alone has even less bias, but several maxima if edges are few. A blur below 0.6 px
only aliases. See docs/measured.md."""


def _gaussian(sigma_px: float) -> NDArray[np.float32]:
    """The middle and one side of a normalised Gaussian kernel."""
    taps = math.ceil(3.5 * sigma_px)
    kernel = np.exp(-0.5 * (np.arange(taps + 1) / sigma_px) ** 2)
    normalised: NDArray[np.float32] = (kernel / (kernel[0] + 2.0 * kernel[1:].sum())).astype(np.float32)
    return normalised


_BLUR, _SHARP = _gaussian(BLUR_SIGMA_PX), _gaussian(SHARP_SIGMA_PX)


@dataclass(frozen=True, slots=True, eq=False)
class EdgePyramid:
    """Edge maps of an image, int8: deviations from the mean over the pixels that count, in steps of which
    `STRENGTH_STEPS` are a standard deviation; `VOID` at masked pixels.

    Attributes:
        bands: level k, at 1/2^(finest + k) of the resolution, shows structure as wide as its blur.
        whole: all structure as wide as the blur of `bands[0]` or wider, at half of its resolution.
        sharp: `bands[0]` plus narrower structure, blurred by `SHARP_SIGMA_PX` only.
    """

    bands: tuple[NDArray[np.int8], ...]
    whole: NDArray[np.int8]
    sharp: NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A part of an image: where it begins and how large it is, pixels."""

    left: int
    top: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """The same part of an array (h, w), as slices."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)

    def halved(self, times: int) -> Rectangle:
        """The same part at a resolution halved `times` times; at least one pixel."""
        left, top = self.left >> times, self.top >> times
        return Rectangle(left, top, max(self.width >> times, 1), max(self.height >> times, 1))

    def within(self, other: Rectangle) -> Rectangle:
        """The same part, relative to the corner of another."""
        return Rectangle(self.left - other.left, self.top - other.top, self.width, self.height)


class EdgeScales:
    """Makes pyramids from the images of one camera, one after the other. The mask at every level, which they share, is
    prepared once."""

    def __init__(
        self,
        lit: NDArray[np.bool_],
        finest: int,
        coarsest: int,
        upright: NDArray[np.float64],
        counted: Rectangle | None = None,
    ) -> None:
        """
        Args:
            lit: (h, w) bool; False = ignore this pixel.
            finest: halvings of the resolution of the first level.
            coarsest: halvings of the resolution of the last level.
            upright: (2,) right and down: image of a unit vector along the axis of the LiDAR. Zero if the camera looks
                along that axis; then no gradient counts less.
            counted: the part of the images from which mean and deviation of the maps are taken; None: all.
        """
        self._counted = Rectangle(0, 0, lit.shape[1], lit.shape[0]) if counted is None else counted
        self._upright = upright.astype(np.float32)
        self._inner = _eroded(lit)
        self._finest = finest
        for _ in range(finest):
            lit = _halved_mask(lit)
        self._lit = [lit]
        for _ in range(finest, coarsest + 1):
            self._lit.append(_halved_mask(self._lit[-1]))
        self._gain = [_gain(lit, _BLUR) for lit in self._lit]
        self._sharp_gain = _gain(self._lit[0], _SHARP)
        # Arrays of the size of an image are made once, because allocating them takes as long as filling them.
        self._gradient, self._edges = np.empty((2, *self._inner.shape), np.float32)
        self._smooth = np.empty(self._lit[0].shape, np.float32)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the images: (h, w)."""
        return self._inner.shape

    def pyramid(self, grey: NDArray[np.uint8]) -> EdgePyramid:
        """Standardised edge maps of an image, which must have the shape `shape`.

        `_less` works in place, so that maps are used before it changes them.
        """
        edges = [_normalised_gradient(grey, self._inner, self._upright, self._gradient, self._edges)]
        for _ in range(self._finest):
            edges = [halved(edges[0])]
        for _ in self._lit[1:]:
            edges.append(halved(edges[-1]))
        wider = [
            _smoothed(level, lit, gain, _BLUR, np.empty_like(level))
            for level, lit, gain in zip(edges[1:], self._lit[1:], self._gain[1:], strict=True)
        ]
        sharp = _smoothed(edges[0], self._lit[0], self._sharp_gain, _SHARP, self._smooth)
        sharp_map = self._standardised(_less(sharp, wider[0]), 0)
        smooth = _smoothed(edges[0], self._lit[0], self._gain[0], _BLUR, self._smooth)
        return EdgePyramid(
            whole=self._standardised(halved(smooth), 1),
            bands=tuple(
                self._standardised(_less(fine, coarse), level)
                for level, (fine, coarse) in enumerate(pairwise([smooth, *wider]))
            ),
            sharp=sharp_map,
        )

    def _standardised(self, values: NDArray[np.float32], level: int) -> NDArray[np.int8]:
        """Deviations from the mean over the pixels that count, in whole steps, `STRENGTH_STEPS` to a standard
        deviation; `VOID` at masked pixels."""
        lit, part = self._lit[level], self._counted.halved(self._finest + level).slices
        (top, bottom, _), (left, right, _) = (cut.indices(size) for cut, size in zip(part, values.shape, strict=True))
        count, total, square = (math.fsum(column) for column in _row_sums(values, lit, top, bottom, left, right).T)
        mean, mean_square = total / max(count, 1.0), square / max(count, 1.0)
        variance = mean_square - mean * mean
        # A map that does not vary beyond rounding has no edges.
        steps = STRENGTH_STEPS / math.sqrt(variance) if variance > 1e-12 * mean_square else 0.0
        return _stepped(values, lit, np.float32(mean), np.float32(steps))


def _gain(lit: NDArray[np.bool_], kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """Factor for a blur over the pixels that count, so that a mask does not look like a valley."""
    if lit.all():
        # All pixels have the same factor: compute one.
        return np.full(lit.shape, _gain_over(lit[:1, :1], kernel)[0, 0])
    return _gain_over(lit, kernel)


@njit(cache=True, parallel=PRANGE)
def _gain_over(lit: NDArray[np.bool_], kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same by squares: far from the border of a mask all pixels have the same factor, and most squares are far
    from it."""
    h, w = lit.shape
    taps, side = kernel.shape[0] - 1, GAIN_SQUARE_PX
    rows, columns = -(-h // side), -(-w // side)
    counts = np.zeros((rows, columns), np.int64)
    for row in prange(rows):
        of_column = np.zeros(w, np.int32)
        for y in range(row * side, min((row + 1) * side, h)):
            for x in range(w):
                of_column[x] += np.int32(lit[y, x])
        for x in range(w):
            counts[row, x // side] += of_column[x]
    whole = kernel[0] + np.float32(2.0) * kernel[1:].sum()
    gain = np.empty((h, w), np.float32)
    for row in prange(rows):
        top, bottom = row * side, min((row + 1) * side, h)
        along = np.empty((side + 2 * taps, side), np.float32)
        for column in range(columns):
            left, right = column * side, min((column + 1) * side, w)
            around, most = 0, 0
            for i in range(max(row - 1, 0), min(row + 2, rows)):
                for j in range(max(column - 1, 0), min(column + 2, columns)):
                    around += counts[i, j]
                    most += (min((i + 1) * side, h) - i * side) * (min((j + 1) * side, w) - j * side)
            if around == 0 or around == most:
                share = whole if around > 0 else np.float32(0.0)
                gain[top:bottom, left:right] = np.float32(1.0) / max(share, np.float32(LEAST_SHARE))
                continue
            for i in range(bottom - top + 2 * taps):
                y = min(max(top + i - taps, 0), h - 1)
                for x in range(left, right):
                    share = kernel[0] * lit[y, x]
                    for k in range(1, taps + 1):
                        share += kernel[k] * (np.float32(lit[y, max(x - k, 0)]) + np.float32(lit[y, min(x + k, w - 1)]))
                    along[i, x - left] = share
            for y in range(top, bottom):
                for x in range(right - left):
                    share = kernel[0] * along[y - top + taps, x]
                    for k in range(1, taps + 1):
                        share += kernel[k] * (along[y - top + taps - k, x] + along[y - top + taps + k, x])
                    gain[y, left + x] = np.float32(1.0) / max(share, np.float32(LEAST_SHARE))
    return gain


def _normalised_gradient(
    grey: NDArray[np.uint8],
    inner: NDArray[np.bool_],
    upright: NDArray[np.float32],
    gradient: NDArray[np.float32],
    out: NDArray[np.float32],
) -> NDArray[np.float32]:
    """The gradient over its local mean; zero outside of `inner`. `gradient` (h, w) is scratch; returns `out`."""
    _gradient(grey, inner, upright, gradient)
    sample = gradient.ravel()[thinned(gradient.size, SAMPLES)]
    steep = sample[sample > 0.0]
    clip = np.float32(np.quantile(steep, CLIP_SHARE) if steep.size else 0.0)
    floor = FLOOR_SHARE * float(np.minimum(sample, clip).mean(dtype=np.float64))
    return _over_local_mean(gradient, clip, np.float32(max(floor, 1e-6)), out)


@njit(cache=True, parallel=PRANGE)
def _gradient(
    grey: NDArray[np.uint8], inner: NDArray[np.bool_], upright: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    """Magnitude of the Sobel gradient, reduced along `upright` (2,); zero on the border and outside of `inner`."""
    h, w = grey.shape
    # |g|² minus (1 - share²) times the square of its part along the axis, so that `UPRIGHT_SHARE` of that part is left.
    spared = np.float32(math.sqrt(1.0 - UPRIGHT_SHARE**2))
    right, down = spared * upright[0], spared * upright[1]
    out[0], out[h - 1], out[:, 0], out[:, w - 1] = 0.0, 0.0, 0.0, 0.0
    for y in prange(1, h - 1):
        # Rows of floats, in which these sums are exact, so that the loops over the pixels run in vector registers.
        across, along = np.empty(w, np.float32), np.empty(w, np.float32)
        for x in range(w):
            above, here, below = np.float32(grey[y - 1, x]), np.float32(grey[y, x]), np.float32(grey[y + 1, x])
            across[x], along[x] = above + np.float32(2.0) * here + below, below - above
        for x in range(1, w - 1):
            gx = across[x + 1] - across[x - 1]
            gy = along[x - 1] + np.float32(2.0) * along[x] + along[x + 1]
            less = right * gx + down * gy
            square = gx * gx + gy * gy - less * less
            steepness = np.sqrt(max(square, np.float32(0.0))) / np.float32(8.0)
            out[y, x] = steepness if inner[y, x] else np.float32(0.0)


@njit(cache=True, parallel=PRANGE, error_model="numpy")
def _over_local_mean(
    values: NDArray[np.float32], clip: np.float32, floor: np.float32, out: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Values clipped at `clip`, divided by the sum of `floor` and their mean over the square of `MEAN_RADIUS_PX` around
    each pixel, as far as it lies in the image. Returns `out`."""
    h, w = values.shape
    r = MEAN_RADIUS_PX
    columns = np.empty(w, np.float32)
    for x in range(w):
        columns[x] = min(x + r, w - 1) - max(x - r, 0) + 1
    # The strips do not depend on the number of threads, and so neither does the rounding of their running sums.
    for strip in prange(-(-h // STRIP_ROWS)):
        first, last = strip * STRIP_ROWS, min((strip + 1) * STRIP_ROWS, h)
        of_column = np.zeros(w, np.float32)
        padded = np.zeros(w + 2 * r + 1, np.float64)
        square = np.empty(w, np.float32)
        for y in range(max(first - r, 0), min(first + r, h)):
            for x in range(w):
                of_column[x] += min(values[y, x], clip)
        for y in range(first, last):
            if y + r < h:
                for x in range(w):
                    of_column[x] += min(values[y + r, x], clip)
            if y - r - 1 >= max(first - r, 0):
                for x in range(w):
                    of_column[x] -= min(values[y - r - 1, x], clip)
            for x in range(w):
                padded[r + 1 + x] = of_column[x]
            total = 0.0
            for x in range(r + 1, 2 * r + 1):
                total += padded[x]
            for x in range(w):
                total += padded[x + 2 * r + 1] - padded[x]
                square[x] = total
            rows = np.float32(min(y + r, h - 1) - max(y - r, 0) + 1)
            for x in range(w):
                out[y, x] = min(values[y, x], clip) / (square[x] / (rows * columns[x]) + floor)
    return out


def _eroded(lit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask without the pixels within two rows and columns of a masked one: the border of a mask is no real edge."""
    return lit if lit.all() else _eroded_by(lit, 2)


@njit(cache=True, parallel=PRANGE)
def _eroded_by(lit: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    h, w = lit.shape
    out = np.empty((h, w), np.bool_)
    for y in prange(h):
        row = np.ones(w + 2 * reach, np.bool_)
        for near in range(max(y - reach, 0), min(y + reach + 1, h)):
            _both(row[reach : reach + w], lit[near])
        out[y] = True
        for k in range(2 * reach + 1):
            _both(out[y], row[k : k + w])
    return out


@njit(cache=True)
def _both(out: NDArray[np.bool_], other: NDArray[np.bool_]) -> None:
    for x in range(out.shape[0]):
        out[x] &= other[x]


@njit(cache=True, parallel=PRANGE)
def _smoothed(
    values: NDArray[np.float32],
    lit: NDArray[np.bool_],
    gain: NDArray[np.float32],
    kernel: NDArray[np.float32],
    out: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Blurs along the rows and along the columns, over the pixels that count; the border is repeated outside.

    Args:
        values, lit, gain: (h, w).
        kernel: (taps + 1,) the middle and one side of a symmetric kernel.
        out: (h, w), returned.
    """
    h, w = values.shape
    taps = kernel.shape[0] - 1
    for strip in prange(-(-h // BLUR_ROWS)):
        top, bottom = strip * BLUR_ROWS, min((strip + 1) * BLUR_ROWS, h)
        above, below = max(top - taps, 0), min(bottom + taps, h)
        along = np.empty((below - above, w), np.float32)
        row = np.empty(w + 2 * taps, np.float32)
        for y in range(above, below):
            for x in range(w):
                row[taps + x] = values[y, x] if lit[y, x] else np.float32(0.0)
            row[:taps] = row[taps]
            row[taps + w :] = row[taps + w - 1]
            _weigh(row[taps : taps + w], kernel[0], along[y - above])
            for k in range(1, taps + 1):
                _add_both(row[taps - k : taps - k + w], row[taps + k : taps + k + w], kernel[k], along[y - above])
        for y in range(top, bottom):
            _weigh(along[y - above], kernel[0], out[y])
            for k in range(1, taps + 1):
                _add_both(along[max(y - k, 0) - above], along[min(y + k, h - 1) - above], kernel[k], out[y])
            for x in range(w):
                out[y, x] *= gain[y, x]
    return out


# These take rows as separate arrays, not as rows of an image: the compiler then knows that they are contiguous and uses
# whole vectors (1.3 instead of 5.1 ns per pixel).
@njit(cache=True)
def _weigh(values: NDArray[np.float32], weight: np.float32, out: NDArray[np.float32]) -> None:
    for x in range(out.shape[0]):
        out[x] = weight * values[x]


@njit(cache=True)
def _add_both(a: NDArray[np.float32], b: NDArray[np.float32], weight: np.float32, out: NDArray[np.float32]) -> None:
    for x in range(out.shape[0]):
        out[x] += weight * (a[x] + b[x])


@njit(cache=True, parallel=PRANGE)
def halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h // 2, w // 2): mean of each square of four; a last odd row or column is left out."""
    h, w = values.shape[0] // 2, values.shape[1] // 2
    out = np.empty((h, w), np.float32)
    for y in prange(h):
        for x in range(w):
            left = values[2 * y, 2 * x] + values[2 * y + 1, 2 * x]
            right = values[2 * y, 2 * x + 1] + values[2 * y + 1, 2 * x + 1]
            out[y, x] = np.float32(0.25) * (left + right)
    return out


def _halved_mask(lit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask at half the resolution: true where all four pixels are."""
    h, w = (lit.shape[0] // 2) * 2, (lit.shape[1] // 2) * 2
    return lit[:h:2, :w:2] & lit[1:h:2, :w:2] & lit[:h:2, 1:w:2] & lit[1:h:2, 1:w:2]


@njit(cache=True, parallel=PRANGE)
def _less(fine: NDArray[np.float32], coarse: NDArray[np.float32]) -> NDArray[np.float32]:
    """`fine` minus `coarse`, a map of half its size, interpolated between its pixels and repeated beyond its border. In
    place: returns `fine`."""
    h, w = coarse.shape
    height, width = fine.shape
    near, far = np.float32(0.75), np.float32(0.25)
    for y in prange(height):
        # Pixel j of the half lies between the pixels 2·j and 2·j + 1 of the whole; a last odd pixel has none.
        a = min(y // 2, h - 1)
        b = min(max(y // 2 - 1 if y % 2 == 0 else a + 1, 0), h - 1)
        for x in range(width):
            c = min(x // 2, w - 1)
            d = min(max(x // 2 - 1 if x % 2 == 0 else c + 1, 0), w - 1)
            fine[y, x] -= near * (near * coarse[a, c] + far * coarse[a, d]) + far * (
                near * coarse[b, c] + far * coarse[b, d]
            )
    return fine


@njit(cache=True, parallel=PRANGE)
def _row_sums(
    values: NDArray[np.float32], lit: NDArray[np.bool_], top: int, bottom: int, left: int, right: int
) -> NDArray[np.float64]:
    """(bottom - top, 3): for each row of a part, the number of pixels that count, their sum and the sum of their
    squares."""
    sums = np.zeros((bottom - top, 3))
    for row in prange(bottom - top):
        of_row, counted = values[top + row, left:right], lit[top + row, left:right]
        count, total, square = 0, 0.0, 0.0
        for x in range(of_row.shape[0]):
            value = float(of_row[x]) if counted[x] else 0.0
            count += counted[x]
            total += value
            square += value * value
        sums[row, 0], sums[row, 1], sums[row, 2] = count, total, square
    return sums


@njit(cache=True, parallel=PRANGE)
def _stepped(
    values: NDArray[np.float32], lit: NDArray[np.bool_], mean: np.float32, steps: np.float32
) -> NDArray[np.int8]:
    out = np.empty(values.shape, np.int8)
    most, half = np.float32(127.0), np.float32(0.5)
    for y in prange(values.shape[0]):
        for x in range(values.shape[1]):
            step = min(max((values[y, x] - mean) * steps, -most), most)
            out[y, x] = np.int8(np.floor(step + half)) if lit[y, x] else VOID
    return out
