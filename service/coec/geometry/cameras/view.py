"""What a camera sees: which pixels there are, and how far from the optical axis a point has one."""

import math

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras.dispatch import project_point
from coec.geometry.cameras.registry import Camera
from coec.geometry.rows import rows_of


def in_image(camera: Camera, uv_px: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(N,): true where the nearest pixel exists: -0.5 <= u < width - 0.5, and v likewise. uv_px: (N, 2)."""
    u, v = rows_of("uv_px", uv_px, 2).T
    inside: NDArray[np.bool_] = (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
    return inside


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
