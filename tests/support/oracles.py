"""Slow, plain implementations that the fast ones are held to: NumPy and loops, written from the papers."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

# ------------------------------------------------------------------------------------------------ camera models
# (N, 3) points in the camera frame to (N, 2) pixels, by formula alone: no domain, no guard.

Intrinsics = Mapping[str, float]


def _pixels(c: Intrinsics, mx: NDArray[np.float64], my: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([c["fx"] * mx + c["cx"], c["fy"] * my + c["cy"]], axis=1)


def _distorted(
    c: Intrinsics, mx: NDArray[np.float64], my: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    r2 = mx**2 + my**2
    radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c.get("k3", 0.0) * r2**3
    return (
        mx * radial + 2 * c["p1"] * mx * my + c["p2"] * (r2 + 2 * mx**2),
        my * radial + c["p1"] * (r2 + 2 * my**2) + 2 * c["p2"] * mx * my,
    )


def pinhole_pixels(c: Intrinsics, p: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = p.T
    return _pixels(c, x / z, y / z)


def radtan_pixels(c: Intrinsics, p: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = p.T
    return _pixels(c, *_distorted(c, x / z, y / z))


def rational_pixels(c: Intrinsics, p: NDArray[np.float64]) -> NDArray[np.float64]:
    mx, my = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
    s = mx**2 + my**2
    g = (1 + c["k1"] * s + c["k2"] * s**2 + c["k3"] * s**3) / (1 + c["k4"] * s + c["k5"] * s**2 + c["k6"] * s**3)
    x = mx * g + 2 * c["p1"] * mx * my + c["p2"] * (s + 2 * mx**2)
    y = my * g + c["p1"] * (s + 2 * my**2) + 2 * c["p2"] * mx * my
    return _pixels(c, x, y)


def kannala_brandt_pixels(c: Intrinsics, p: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = p.T
    theta, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    d = theta + sum(c[f"k{i}"] * theta ** (2 * i + 1) for i in (1, 2, 3, 4))
    return _pixels(c, d * np.cos(azimuth), d * np.sin(azimuth))


def mei_pixels(c: Intrinsics, p: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = (p / np.linalg.norm(p, axis=1, keepdims=True)).T
    return _pixels(c, *_distorted(c, x / (z + c["xi"]), y / (z + c["xi"])))


def eucm_pixels(c: Intrinsics, p: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = p.T
    d = np.sqrt(c["beta"] * (x**2 + y**2) + z**2)
    depth = c["alpha"] * d + (1 - c["alpha"]) * z
    return _pixels(c, x / depth, y / depth)


def double_sphere_pixels(c: Intrinsics, p: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = p.T
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (c["xi"] * d1 + z) ** 2)
    depth = c["alpha"] * d2 + (1 - c["alpha"]) * (c["xi"] * d1 + z)
    return _pixels(c, x / depth, y / depth)


CAMERA_PIXELS: Mapping[str, Callable[[Intrinsics, NDArray[np.float64]], NDArray[np.float64]]] = {
    "pinhole": pinhole_pixels,
    "radtan": radtan_pixels,
    "rational": rational_pixels,
    "kannala_brandt": kannala_brandt_pixels,
    "mei": mei_pixels,
    "eucm": eucm_pixels,
    "double_sphere": double_sphere_pixels,
}


# ------------------------------------------------------------------------------------------ mutual information
def entropy(p: NDArray[np.float64]) -> float:
    """-Σ p log p in nats."""
    p = p[p > 0.0]
    return float(-(p * np.log(p)).sum())


def mutual_information_of_frame(
    uv_px: NDArray[np.float64],
    valid: NDArray[np.bool_],
    range_bin: NDArray[np.integer],
    depth_bin: NDArray[np.integer],
    bins: tuple[int, int],
) -> tuple[float, int]:
    """Equation (1) of one frame, term by term: (MI in nats, number of points).

    uv_px (N, 2) and valid (N,): where the points fall; range_bin (N,); depth_bin (h, w), bins[0] where
    there is no value.
    """
    h, w = depth_bin.shape
    column, row = np.floor(uv_px[:, 0] + 0.5), np.floor(uv_px[:, 1] + 0.5)
    inside = valid & (column >= 0) & (row >= 0) & (column < w) & (row < h)
    d = depth_bin[row[inside].astype(int), column[inside].astype(int)]
    r = range_bin[inside][d < bins[0]]
    d = d[d < bins[0]]
    if len(d) == 0:
        return 0.0, 0
    joint, _, _ = np.histogram2d(d, r, bins=bins, range=((-0.5, bins[0] - 0.5), (-0.5, bins[1] - 0.5)))
    p = joint / joint.sum()
    return entropy(p.sum(axis=1)) + entropy(p.sum(axis=0)) - entropy(p.ravel()), len(d)


# ------------------------------------------------------------------------------------------------ edge alignment
def sobel_magnitude(grey: NDArray[np.uint8], upright: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """|∇I| in grey values per pixel, of which the part along `upright` (2,), a unit vector or shorter, counts `share`;
    zero on the border."""
    image = grey.astype(np.float64)
    out = np.zeros(grey.shape)
    across = np.array([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8.0
    for y in range(1, grey.shape[0] - 1):
        for x in range(1, grey.shape[1] - 1):
            patch = image[y - 1 : y + 2, x - 1 : x + 2]
            gradient = np.array([(across * patch).sum(), (across.T * patch).sum()])
            out[y, x] = np.sqrt(gradient @ gradient - (1.0 - share**2) * (gradient @ upright) ** 2)
    return out


def local_mean(values: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    """Mean over the square around each pixel, as far as it lies in the image."""
    out = np.empty(values.shape)
    for y in range(values.shape[0]):
        for x in range(values.shape[1]):
            out[y, x] = values[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1].mean()
    return out


def gaussian_blur(values: NDArray[np.float64], sigma: float, taps: int) -> NDArray[np.float64]:
    """Convolved with a Gaussian cut off at `taps` pixels; the border pixel is repeated outside."""
    kernel = np.exp(-0.5 * (np.arange(-taps, taps + 1) / sigma) ** 2)
    kernel = np.outer(kernel, kernel) / kernel.sum() ** 2
    padded = np.pad(values, taps, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape)
    return np.asarray((windows * kernel).sum(axis=(2, 3)))


def standardised_over(values: NDArray[np.float64], lit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Zero mean, unit standard deviation over the pixels that count; NaN at the others."""
    return np.where(lit, (values - values[lit].mean()) / values[lit].std(), np.nan)


def alignment_sums(
    uv_px: NDArray[np.float64],
    valid: NDArray[np.bool_],
    weight: NDArray[np.floating],
    edges: NDArray[np.floating],
    between_pixels: bool,
) -> tuple[float, float]:
    """Σ w·e and Σ w² of one frame, point by point.

    uv_px (N, 2) and valid (N,): where the points fall; edges (h, w), NaN = masked. `between_pixels`: e is interpolated
    from the four pixels around, all of which must exist and count; else e is that of the nearest pixel.
    """
    h, w = edges.shape
    strength, square = 0.0, 0.0
    for (u, v), visible, weighs in zip(uv_px, valid, weight.astype(np.float64), strict=True):
        if not visible:
            continue
        if between_pixels:
            column, row = int(np.floor(u)), int(np.floor(v))
            if column < 0 or row < 0 or column + 1 >= w or row + 1 >= h:
                continue
            a, b = u - column, v - row
            e = np.array([1 - b, b]) @ edges[row : row + 2, column : column + 2].astype(np.float64) @ [1 - a, a]
        else:
            column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
            if column < 0 or row < 0 or column >= w or row >= h:
                continue
            e = float(edges[row, column])
        if np.isfinite(e):
            strength += weighs * e
            square += weighs**2
    return strength, square


def doubled(values: NDArray[np.floating], shape: tuple[int, int]) -> NDArray[np.float64]:
    """An image of half the resolution, interpolated at the pixels of the whole; outside, its border is repeated."""
    out = np.empty(shape)
    last = np.array(values.shape) - 1
    for pixel in np.ndindex(shape):
        # Pixel j of the half covers the pixels 2j and 2j + 1, so its centre lies at 2j + 0.5.
        at = np.clip((np.array(pixel) - 0.5) / 2.0, 0.0, last)
        low = np.minimum(at.astype(int), np.maximum(last - 1, 0))
        high, (a, b) = np.minimum(low + 1, last), at - low
        out[pixel] = (1 - a) * ((1 - b) * values[low[0], low[1]] + b * values[low[0], high[1]])
        out[pixel] += a * ((1 - b) * values[high[0], low[1]] + b * values[high[0], high[1]])
    return out


def stereographic_ray(x: float, y: float) -> NDArray[np.float64]:
    """Unit direction of a point of the stereographic plane, tan(θ/2) from its middle at the angle θ off the axis."""
    theta, phi = 2.0 * np.arctan(np.hypot(x, y)), np.arctan2(y, x)
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def charted_sums(
    p_camera: NDArray[np.float32],
    weight_steps: NDArray[np.integer],
    cells: NDArray[np.integer],
    cells_per_unit: np.float32,
    centre: NDArray[np.float32],
) -> tuple[int, int]:
    """Σ w·e and Σ w², in whole steps, of one frame on its chart, point by point.

    p_camera (N, 3); cells (h, w): strengths in steps, -128 where none is known. In single precision, as is what it
    checks: which cell a point falls on is decided there.
    """
    strength, square = 0, 0
    for (x, y, z), w in zip(p_camera, weight_steps.tolist(), strict=True):
        with np.errstate(all="ignore"):
            scale = cells_per_unit / (np.sqrt(x * x + y * y + z * z) + z)
            column, row = x * scale + (centre[0] + np.float32(0.5)), y * scale + (centre[1] + np.float32(0.5))
        if not (0.0 <= column < cells.shape[1] and 0.0 <= row < cells.shape[0]):
            continue
        steps = int(cells[int(row), int(column)])
        if steps != -128:
            strength += w * steps
            square += w * w
    return strength, square
