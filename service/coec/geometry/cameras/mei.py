"""Unified sphere model with radial and tangential distortion (KITTI-360's `MEI`).

With d = sqrt(x^2 + y^2 + z^2): the distortion of `brown_conrady` is applied to (x, y) / (z + xi d), then fx, fy, cx,
cy (the gamma1, gamma2, u0, v0 of KITTI-360) give the pixel.

C. Mei, P. Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007, section II.
Domain: the points on the near side of the sphere's silhouette, z > -w d with w = xi for xi <= 1 and 1/xi above
(V. Usenko, N. Demmel, D. Cremers, "The Double Sphere Camera Model", 3DV 2018, section on the UCM), and a radius
below the one at which the radial polynomial stops growing.
"""

import math
from typing import NamedTuple

from coec.geometry.cameras.base import (
    common_intrinsics,
    distort,
    finite,
    guarded_ray,
    like,
    monotonic_limit_squared,
    undistort,
    within,
)

# Calibrations of real lenses have xi of 0 to 4; far above, the image no longer depends on it.
_MAX_XI = 1e3


class Mei(NamedTuple):
    """Size, focal lengths and principal point in pixels; mirror parameter xi; distortion; derived limits.

    min_cosine: lower bound of z/d. max_radius2: upper bound of the squared radius before distortion.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    xi: float
    k1: float
    k2: float
    p1: float
    p2: float
    min_cosine: float
    max_radius2: float


def build(
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    xi: float,
    k1: float,
    k2: float,
    p1: float,
    p2: float,
) -> Mei:
    """A checked camera (0 <= xi <= 1000). Raises ValueError that names the field."""
    xi = within("xi", xi, 0.0, _MAX_XI)
    return Mei(
        *common_intrinsics(width, height, fx, fy, cx, cy),
        xi,
        finite("k1", k1),
        finite("k2", k2),
        finite("p1", p1),
        finite("p2", p2),
        -xi if xi <= 1.0 else -1.0 / xi,
        monotonic_limit_squared((k1, k2)),
    )


def image_point(camera: Mei, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel of a point in the camera frame, and whether the point is in the domain."""
    zero, one = like(0.0, z), like(1.0, z)
    distance = math.sqrt(x * x + y * y + z * z)
    depth = z + camera.xi * distance
    in_front = (z > camera.min_cosine * distance) & (depth > zero)
    inverse_depth = one / (depth if in_front else one)
    mx = x * inverse_depth
    my = y * inverse_depth
    in_domain = in_front & (mx * mx + my * my < camera.max_radius2)
    dx, dy = distort(camera.k1, camera.k2, camera.p1, camera.p2, zero, mx, my)
    return camera.fx * dx + camera.cx, camera.fy * dy + camera.cy, in_domain


def unproject_point(camera: Mei, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray in the camera frame of a pixel, and whether the pixel is the image of a point in the domain."""
    mx, my, converged = undistort(
        camera.k1,
        camera.k2,
        camera.p1,
        camera.p2,
        0.0,
        camera.max_radius2,
        (u - camera.cx) / camera.fx,
        (v - camera.cy) / camera.fy,
    )
    radius2 = mx * mx + my * my
    discriminant = 1.0 + (1.0 - camera.xi * camera.xi) * radius2  # negative: outside the sphere's silhouette
    factor = (camera.xi + math.sqrt(max(discriminant, 0.0))) / (1.0 + radius2)
    return guarded_ray(factor * mx, factor * my, factor - camera.xi, converged & (discriminant > 0.0))
