"""Double sphere model.

    d1 = sqrt(x^2 + y^2 + z^2),   z' = xi d1 + z,   d2 = sqrt(x^2 + y^2 + z'^2)
    u = fx x / (alpha d2 + (1 - alpha) z') + cx, and v likewise

V. Usenko, N. Demmel, D. Cremers, "The Double Sphere Camera Model", 3DV 2018, equations (40) to (42); the inverse is
equations (46) to (52).

Domain: z > -w2 d1 of equations (43) to (45),

    w2 = (w1 + xi) / sqrt(2 w1 xi + xi^2 + 1),   w1 = alpha/(1 - alpha) for alpha <= 0.5, (1 - alpha)/alpha above,

the bound that other programs use. The exact limit up to which directions and pixels are one to one is z' > -w1 d2. For
real lenses equation (43) stops 0.1 to 3 degrees short of it. For a strongly negative xi it lies beyond it, and then the
exact limit is taken.
"""

import math
from typing import NamedTuple

from coec.geometry.cameras.base import common_intrinsics, guarded_ray, like, within

# At xi = -1 the second sphere's centre lies on the first sphere and the optical axis itself has no image.
MIN_XI, MAX_XI = -0.999, 1.0


class DoubleSphere(NamedTuple):
    """Size, focal lengths and principal point in pixels; xi and alpha; derived: min_cosine, lower bound of z/d1."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    xi: float
    alpha: float
    min_cosine: float


def _min_cosine(xi: float, alpha: float) -> float:
    """The lower bound of z/d1: equations (43) to (45), or the exact one where that is the stricter."""
    w1 = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
    w2 = (w1 + xi) / math.sqrt(2.0 * w1 * xi + xi * xi + 1.0)
    # z' = -w1 d2 with d1 = 1 and d2^2 = 1 + 2 xi z + xi^2 is a quadratic in d2; this is its solution, put into z.
    exact = xi * (w1 * w1 - 1.0) - w1 * math.sqrt(xi * xi * (w1 * w1 - 1.0) + 1.0)
    return max(-w2, exact)


def build(
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    xi: float,
    alpha: float,
) -> DoubleSphere:
    """A checked camera (-0.999 <= xi <= 1, 0 <= alpha <= 1). Raises ValueError that names the field."""
    xi = within("xi", xi, MIN_XI, MAX_XI)
    alpha = within("alpha", alpha, 0.0, 1.0)
    return DoubleSphere(*common_intrinsics(width, height, fx, fy, cx, cy), xi, alpha, _min_cosine(xi, alpha))


def image_point(camera: DoubleSphere, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel of a point in the camera frame, and whether the point is in the domain."""
    zero, one = like(0.0, z), like(1.0, z)
    radius2 = x * x + y * y
    d1 = math.sqrt(radius2 + z * z)
    shifted_z = camera.xi * d1 + z
    d2 = math.sqrt(radius2 + shifted_z * shifted_z)
    depth = camera.alpha * d2 + (one - camera.alpha) * shifted_z
    in_domain = (z > camera.min_cosine * d1) & (depth > zero)
    inverse_depth = one / (depth if in_domain else one)
    return camera.fx * (x * inverse_depth) + camera.cx, camera.fy * (y * inverse_depth) + camera.cy, in_domain


def unproject_point(camera: DoubleSphere, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray in the camera frame of a pixel, and whether the pixel is the image of a point in the domain."""
    mx = (u - camera.cx) / camera.fx
    my = (v - camera.cy) / camera.fy
    radius2 = mx * mx + my * my
    discriminant = 1.0 - (2.0 * camera.alpha - 1.0) * radius2  # negative: outside the second silhouette
    mz = (1.0 - camera.alpha * camera.alpha * radius2) / (
        camera.alpha * math.sqrt(max(discriminant, 0.0)) + (1.0 - camera.alpha)
    )
    first_discriminant = mz * mz + (1.0 - camera.xi * camera.xi) * radius2
    factor = (mz * camera.xi + math.sqrt(max(first_discriminant, 0.0))) / (mz * mz + radius2)
    z = factor * mz - camera.xi
    return guarded_ray(
        factor * mx, factor * my, z, (discriminant > 0.0) & (z > camera.min_cosine)
    )  # (x, y, z) is on the unit sphere already, so z is z/d1
