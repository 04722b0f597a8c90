"""Pinhole: u = fx x/z + cx, v = fy y/z + cy for z > 0."""

from typing import NamedTuple

from coec.geometry.cameras.base import common_intrinsics, guarded_ray, like


class Pinhole(NamedTuple):
    """Size in pixels, focal lengths and principal point in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


def build(*, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Pinhole:
    """A checked camera. Raises ValueError that names the field."""
    return Pinhole(*common_intrinsics(width, height, fx, fy, cx, cy))


def image_point(camera: Pinhole, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel of a point in the camera frame, and whether the point is in the domain: z > 0."""
    one = like(1.0, z)
    in_domain = z > like(0.0, z)
    inverse_z = one / (z if in_domain else one)
    return camera.fx * (x * inverse_z) + camera.cx, camera.fy * (y * inverse_z) + camera.cy, in_domain


def unproject_point(camera: Pinhole, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray in the camera frame of a pixel; every finite pixel has one."""
    return guarded_ray((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0, True)
