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

    uv_px (N, 2) and valid (N,): where the points fall; range_bin (N,); depth_bin (h, w), bins[0] where there is no value.
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
