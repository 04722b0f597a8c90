"""Extended unified camera model.

With d = sqrt(beta (x^2 + y^2) + z^2): u = fx x / (alpha d + (1 - alpha) z) + cx, and v likewise.

B. Khomutenko, G. Garcia, P. Martinet, "An Enhanced Unified Camera Model", RA-L 1(1), 2016. Domain: z > -w d with
w = alpha/(1 - alpha) for alpha <= 0.5 and (1 - alpha)/alpha above (V. Usenko, N. Demmel, D. Cremers, "The Double Sphere
Camera Model", 3DV 2018, section on the EUCM, where the inverse is given as well).
"""

import math
from typing import NamedTuple

from coec.geometry.cameras.base import common_intrinsics, guarded_ray, like, positive, within


class Eucm(NamedTuple):
    """Size, focal lengths and principal point in pixels; alpha and beta; derived: min_cosine, bound of z/d."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    alpha: float
    beta: float
    min_cosine: float


def build(
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    alpha: float,
    beta: float,
) -> Eucm:
    """A checked camera (0 <= alpha <= 1, beta > 0). Raises ValueError that names the field."""
    alpha = within("alpha", alpha, 0.0, 1.0)
    return Eucm(
        *common_intrinsics(width, height, fx, fy, cx, cy),
        alpha,
        positive("beta", beta),
        -alpha / (1.0 - alpha) if alpha <= 0.5 else -(1.0 - alpha) / alpha,
    )


def image_point(camera: Eucm, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel of a point in the camera frame, and whether the point is in the domain."""
    zero, one = like(0.0, z), like(1.0, z)
    distance = math.sqrt(camera.beta * (x * x + y * y) + z * z)
    depth = camera.alpha * distance + (one - camera.alpha) * z
    in_domain = (z > camera.min_cosine * distance) & (depth > zero)
    inverse_depth = one / (depth if in_domain else one)
    return camera.fx * (x * inverse_depth) + camera.cx, camera.fy * (y * inverse_depth) + camera.cy, in_domain


def unproject_point(camera: Eucm, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray in the camera frame of a pixel, and whether the pixel is the image of a point in the domain."""
    mx = (u - camera.cx) / camera.fx
    my = (v - camera.cy) / camera.fy
    scaled_radius2 = camera.beta * (mx * mx + my * my)
    discriminant = 1.0 - (2.0 * camera.alpha - 1.0) * scaled_radius2  # negative: outside the silhouette
    mz = (1.0 - camera.alpha * camera.alpha * scaled_radius2) / (
        camera.alpha * math.sqrt(max(discriminant, 0.0)) + (1.0 - camera.alpha)
    )
    return guarded_ray(mx, my, mz, discriminant > 0.0)
