"""Pinhole with radial and tangential distortion (OpenCV's k1 k2 p1 p2 k3; ROS `plumb_bob`).

The distortion of `brown_conrady` is applied to (x/z, y/z). Domain: z > 0 and (x/z)^2 + (y/z)^2 below the square of the
radius at which the radial polynomial stops growing; OpenCV itself has no such bound and folds such points back.
"""

from typing import NamedTuple

from coec.geometry.cameras.base import (
    common_intrinsics,
    distort,
    finite,
    guarded_ray,
    like,
    monotonic_limit_squared,
    undistort,
)


class RadTan(NamedTuple):
    """Size, focal lengths and principal point in pixels; distortion coefficients; derived: max_radius2."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    max_radius2: float


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
    p1: float,
    p2: float,
    k3: float,
) -> RadTan:
    """A checked camera. Raises ValueError that names the field."""
    return RadTan(
        *common_intrinsics(width, height, fx, fy, cx, cy),
        finite("k1", k1),
        finite("k2", k2),
        finite("p1", p1),
        finite("p2", p2),
        finite("k3", k3),
        monotonic_limit_squared((k1, k2, k3)),
    )


def image_point(camera: RadTan, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel of a point in the camera frame, and whether the point is in the domain."""
    one = like(1.0, z)
    in_front = z > like(0.0, z)
    inverse_z = one / (z if in_front else one)
    mx = x * inverse_z
    my = y * inverse_z
    in_domain = in_front & (mx * mx + my * my < camera.max_radius2)
    dx, dy = distort(camera.k1, camera.k2, camera.p1, camera.p2, camera.k3, mx, my)
    return camera.fx * dx + camera.cx, camera.fy * dy + camera.cy, in_domain


def unproject_point(camera: RadTan, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray in the camera frame of a pixel, and whether the pixel is the image of a point in the domain."""
    mx, my, converged = undistort(
        camera.k1,
        camera.k2,
        camera.p1,
        camera.p2,
        camera.k3,
        camera.max_radius2,
        (u - camera.cx) / camera.fx,
        (v - camera.cy) / camera.fy,
    )
    return guarded_ray(mx, my, 1.0, converged)
