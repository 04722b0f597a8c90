"""How much of an edge there is at every pixel, at several scales: what range edges are laid onto.

Gradient magnitude, clipped, divided by its local mean (so that a hedge does not outshine a house), blurred with a
Gaussian of two pixels at every level of a pyramid whose levels halve the resolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

CLIP_SHARE = 0.95
"""Gradients are clipped at this quantile: reflections and lamps would outweigh the rest."""

QUANTILE_SAMPLES = 100_000
"""Gradients from which that quantile is taken, flat pixels apart."""

MEAN_RADIUS_PX = 20
"""The local mean is over a square of 41 px (METHOD: 40 px)."""

FLOOR_SHARE = 0.25
"""Added to the local mean, as a share of the mean of the whole image: noise of flat regions is not blown up to
edges."""

BLUR_SIGMA_PX = 2.0
"""Blur of each level, in pixels of that level: 2, 4, 8 ... pixels of the image."""

_TAPS = 7
_KERNEL = np.exp(-0.5 * (np.arange(-_TAPS, _TAPS + 1) / BLUR_SIGMA_PX) ** 2)
_KERNEL /= _KERNEL.sum()
_KERNEL = _KERNEL.astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class EdgePyramid:
    """Level k is at 1/2^k of the resolution: (h_k, w_k) float32, zero mean and unit standard deviation over the pixels
    that count, NaN at masked ones."""

    levels: tuple[NDArray[np.float32], ...]


def edge_pyramid(grey: NDArray[np.uint8], lit: NDArray[np.bool_], levels: int) -> EdgePyramid:
    """Standardised edge maps of an image.

    Args:
        grey: (h, w) uint8.
        lit: (h, w) bool; False = ignore this pixel.
        levels: number of levels.
    """
    edges = _normalised_gradient(grey, lit)
    out = []
    for _ in range(levels):
        out.append(_standardised(_blurred(edges), lit))
        edges, lit = halved(edges), _halved_mask(lit)
    return EdgePyramid(tuple(out))


def _normalised_gradient(grey: NDArray[np.uint8], lit: NDArray[np.bool_]) -> NDArray[np.float32]:
    gradient = _gradient(grey)
    # The border of the mask is an edge of nothing.
    gradient[~_eroded(lit)] = 0.0
    values = gradient[gradient > 0.0]
    clip = np.quantile(values[:: max(1, values.size // QUANTILE_SAMPLES)], CLIP_SHARE) if values.size else 0.0
    gradient = np.minimum(gradient, np.float32(clip))
    local = _local_mean(gradient)
    floor = FLOOR_SHARE * float(local.mean())
    normalised: NDArray[np.float32] = (gradient / np.maximum(local + floor, 1e-6)).astype(np.float32)
    return normalised


@njit(cache=True, parallel=True)
def _gradient(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Magnitude of the Sobel gradient; zero on the border."""
    h, w = grey.shape
    out = np.zeros((h, w), np.float32)
    for y in prange(1, h - 1):
        for x in range(1, w - 1):
            a, b, c = float(grey[y - 1, x - 1]), float(grey[y - 1, x]), float(grey[y - 1, x + 1])
            d, e = float(grey[y, x - 1]), float(grey[y, x + 1])
            f, g, i = float(grey[y + 1, x - 1]), float(grey[y + 1, x]), float(grey[y + 1, x + 1])
            gx = (c - a) + 2.0 * (e - d) + (i - f)
            gy = (f - a) + 2.0 * (g - b) + (i - c)
            out[y, x] = math.sqrt(gx * gx + gy * gy) / 8.0
    return out


def _eroded(lit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Without the pixels within two rows and columns of a masked one."""
    if lit.all():
        return lit
    for axis in (0, 1):
        padded = np.pad(lit, [(2, 2) if axis == k else (0, 0) for k in (0, 1)], mode="edge")
        lit = np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=axis).all(axis=-1))
    return lit


def _local_mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean over the square of `MEAN_RADIUS_PX` around each pixel, as far as it lies in the image."""
    for axis in (0, 1):
        length = values.shape[axis]
        total = np.zeros((length + 1, values.shape[1 - axis]), np.float64)
        np.cumsum(np.moveaxis(values, axis, 0), axis=0, out=total[1:])
        low = np.maximum(np.arange(length) - MEAN_RADIUS_PX, 0)
        high = np.minimum(np.arange(length) + MEAN_RADIUS_PX + 1, length)
        values = np.moveaxis((total[high] - total[low]) / (high - low)[:, None], 0, axis).astype(np.float32)
    return values


def _blurred(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return _blurred_along_rows(_blurred_along_rows(values).T.copy()).T.copy()


@njit(cache=True, parallel=True)
def _blurred_along_rows(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Gaussian along the second axis; the border pixel is repeated outside."""
    h, w = values.shape
    out = np.empty((h, w), np.float32)
    for y in prange(h):
        row = np.empty(w + 2 * _TAPS, np.float32)
        row[:_TAPS] = values[y, 0]
        row[_TAPS : _TAPS + w] = values[y]
        row[_TAPS + w :] = values[y, w - 1]
        total = np.zeros(w, np.float32)
        for k in range(2 * _TAPS + 1):
            tap, shifted = _KERNEL[k], row[k : k + w]
            for x in range(w):
                total[x] += tap * shifted[x]
        out[y] = total
    return out


def halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h // 2, w // 2): mean of each square of four; a last odd row or column is left out."""
    h, w = (values.shape[0] // 2) * 2, (values.shape[1] // 2) * 2
    quads = values[:h:2, :w:2] + values[1:h:2, :w:2] + values[:h:2, 1:w:2] + values[1:h:2, 1:w:2]
    return (quads / 4.0).astype(np.float32)


def _halved_mask(lit: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """True where all four are."""
    h, w = (lit.shape[0] // 2) * 2, (lit.shape[1] // 2) * 2
    return lit[:h:2, :w:2] & lit[1:h:2, :w:2] & lit[:h:2, 1:w:2] & lit[1:h:2, 1:w:2]


def _standardised(values: NDArray[np.float32], lit: NDArray[np.bool_]) -> NDArray[np.float32]:
    counted = values[lit]
    if counted.size == 0 or counted.std() <= 0.0:
        return np.where(lit, np.float32(0.0), np.float32(np.nan))
    standardised = (values - counted.mean()) / counted.std()
    maps: NDArray[np.float32] = np.where(lit, standardised, np.nan).astype(np.float32)
    return maps
