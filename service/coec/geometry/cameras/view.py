"""What a camera sees: which pixels exist, how far from the optical axis points still have a pixel, and the angle that a
pixel covers."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras.dispatch import project_point
from coec.geometry.cameras.registry import Camera
from coec.geometry.vectors import rows_of

_STEP = 1e-3
"""Step in radians that is small enough for every camera model to be linear."""


def in_image(camera: Camera, uv_px: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(N,): true where the nearest pixel exists: -0.5 <= u < width - 0.5, and v likewise. uv_px: (N, 2)."""
    u, v = rows_of("uv_px", uv_px, 2).T
    inside: NDArray[np.bool_] = (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
    return inside


@lru_cache(maxsize=64, typed=True)
def in_single_precision(camera: Camera) -> Camera:
    """The same camera with intrinsics as float32: in single precision a vector register holds twice as many points."""
    return type(camera)(*(field if isinstance(field, int) else np.float32(field) for field in camera))  # type: ignore[arg-type]


def domain_angle_rad(camera: Camera) -> float:
    """The angle from the optical axis, in (0, π], up to which a point has a pixel. In every model the domain is a cone
    about the axis."""
    low, high = 0.0, math.pi
    for angle in np.linspace(0.0, math.pi, 257)[1:].tolist():
        if not project_point(camera, math.sin(angle), 0.0, math.cos(angle))[2]:
            high = angle
            break
        low = angle
    while low < (middle := 0.5 * (low + high)) < high:  # bisection down to the last bit
        if project_point(camera, math.sin(middle), 0.0, math.cos(middle))[2]:
            low = middle
        else:
            high = middle
    return low


def pixel_rad(camera: Camera) -> float:
    """The angle that a pixel on the optical axis covers, radians; the larger one if rows and columns differ. It is
    measured by projection, because the focal length of a fisheye is not in pixels per radian."""
    u, v, _ = project_point(camera, 0.0, 0.0, 1.0)
    neighbours = project_point(camera, _STEP, 0.0, 1.0), project_point(camera, 0.0, _STEP, 1.0)
    return _STEP / min(math.hypot(right - u, down - v) for right, down, _ in neighbours)
