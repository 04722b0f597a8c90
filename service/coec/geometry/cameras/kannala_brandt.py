"""Kannala-Brandt fisheye with four coefficients (OpenCV's `fisheye`, ROS `equidistant`).

With r = sqrt(x^2 + y^2) and theta = atan2(r, z):

    d(theta) = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    u = fx d(theta) x/r + cx,   v = fy d(theta) y/r + cy

J. Kannala, S. S. Brandt, "A generic camera model and calibration method for conventional, wide-angle, and fish-eye
lenses", PAMI 28(8), 2006, equations (6) and (7) in OpenCV's normalisation. Domain: theta below the angle at which
d stops growing, and below pi. OpenCV has no such bound.
"""

import math
from typing import NamedTuple

from coec.geometry.cameras.base import (
    common_intrinsics,
    finite,
    guarded_ray,
    like,
    monotonic_limit_squared,
    odd_polynomial,
    polar_angle,
    solve_odd_polynomial,
)

# Keeps x/r finite on the optical axis, where x = r = 0 (then theta = 0 too). Nearer to the axis than this, the pixel is
# the principal point to the last bit, with or without; and a float32 can hold it. Unit: m.
_MIN_RADIUS_M = 1e-30


class KannalaBrandt(NamedTuple):
    """Size, focal lengths and principal point in pixels; distortion coefficients; derived: max_theta_rad."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    k3: float
    k4: float
    max_theta_rad: float


def build(
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    k1: float,
    k2: float,
    k3: float,
    k4: float,
) -> KannalaBrandt:
    """A checked camera. Raises ValueError that names the field."""
    return KannalaBrandt(
        *common_intrinsics(width, height, fx, fy, cx, cy),
        finite("k1", k1),
        finite("k2", k2),
        finite("k3", k3),
        finite("k4", k4),
        min(math.sqrt(monotonic_limit_squared((k1, k2, k3, k4))), math.pi),
    )


def image_point(camera: KannalaBrandt, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel of a point in the camera frame, and whether the point is in the domain."""
    radius = math.sqrt(x * x + y * y)
    theta = polar_angle(radius, z)
    in_domain = theta < camera.max_theta_rad
    distorted = odd_polynomial(camera.k1, camera.k2, camera.k3, camera.k4, theta)
    least = like(_MIN_RADIUS_M, z)
    scale = distorted / (radius if radius > least else least)
    return camera.fx * (x * scale) + camera.cx, camera.fy * (y * scale) + camera.cy, in_domain


def unproject_point(camera: KannalaBrandt, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray in the camera frame of a pixel, and whether the pixel is the image of a point in the domain."""
    mx = (u - camera.cx) / camera.fx
    my = (v - camera.cy) / camera.fy
    distorted = math.sqrt(mx * mx + my * my)
    theta, converged = solve_odd_polynomial(camera.k1, camera.k2, camera.k3, camera.k4, distorted, camera.max_theta_rad)
    scale = math.sin(theta) / distorted if distorted > _MIN_RADIUS_M else 1.0
    return guarded_ray(mx * scale, my * scale, math.cos(theta), converged)
