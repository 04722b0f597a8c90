"""Pinhole with rational radial and tangential distortion (OpenCV's k1 k2 p1 p2 k3 k4 k5 k6; ROS `rational_polynomial`).

With (x, y) the point over its depth, s = x^2 + y^2 and g = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3):

    x' = x g + 2 p1 x y + p2 (s + 2 x^2)
    y' = y g + p1 (s + 2 y^2) + 2 p2 x y

D. Claus, A. Fitzgibbon, "A rational function lens distortion model for general cameras", CVPR 2005, in the form of
OpenCV's `projectPoints`. Domain: z > 0 and a radius below the one at which r g(r^2) stops growing or its denominator
is zero; OpenCV itself has no such bound and folds such points back.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from coec.geometry.cameras.base import common_intrinsics, finite, first_positive_root, guarded_ray, like

# Most doublings that find the bracket, and most halvings of it, as in `polynomial`.
_MAX_BISECTIONS = 100
# Newton's method converges quadratically from the radial solution; real lenses need three to five steps.
_MAX_STEPS = 30
# Largest distance between a pixel and the re-distorted solution, in normalised coordinates: a millionth of a pixel.
_TOLERANCE = 1e-9


class Rational(NamedTuple):
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
    k4: float
    k5: float
    k6: float
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
    k4: float,
    k5: float,
    k6: float,
) -> Rational:
    """A checked camera. Raises ValueError that names the field."""
    above = np.array([1.0, finite("k1", k1), finite("k2", k2), finite("k3", k3)])
    below = np.array([1.0, finite("k4", k4), finite("k5", k5), finite("k6", k6)])
    return Rational(
        *common_intrinsics(width, height, fx, fy, cx, cy),
        float(k1),
        float(k2),
        finite("p1", p1),
        finite("p2", p2),
        float(k3),
        float(k4),
        float(k5),
        float(k6),
        _growing_squared(above, below),
    )


def _growing_squared(above: NDArray[np.float64], below: NDArray[np.float64]) -> float:
    """Square of the radius up to which r above(r^2) / below(r^2) grows: with s = r^2 its slope has the sign of
    above below + 2 s (above' below - above below')."""
    numerator, denominator = Polynomial(above), Polynomial(below)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused with its root
        turned = numerator.deriv() * denominator - numerator * denominator.deriv()
        slope = numerator * denominator + Polynomial([0.0, 2.0]) * turned
    return min(first_positive_root(np.asarray(slope.coef, np.float64)), first_positive_root(below))


def rational_factor(camera: Rational, s: float) -> float:
    """g of the squared radius s."""
    one = like(1.0, s)
    above = one + s * (camera.k1 + s * (camera.k2 + s * camera.k3))
    below = one + s * (camera.k4 + s * (camera.k5 + s * camera.k6))
    return above / below


def rational_slope(camera: Rational, s: float) -> float:
    """dg/ds at the squared radius s."""
    above = 1.0 + s * (camera.k1 + s * (camera.k2 + s * camera.k3))
    below = 1.0 + s * (camera.k4 + s * (camera.k5 + s * camera.k6))
    above_slope = camera.k1 + s * (2.0 * camera.k2 + s * 3.0 * camera.k3)
    below_slope = camera.k4 + s * (2.0 * camera.k5 + s * 3.0 * camera.k6)
    return (above_slope * below - above * below_slope) / (below * below)


def rational_distort(camera: Rational, x: float, y: float) -> tuple[float, float]:
    """Distorted normalised coordinates of (x, y)."""
    two = like(2.0, x)
    s = x * x + y * y
    g = rational_factor(camera, s)
    return (
        x * g + two * camera.p1 * x * y + camera.p2 * (s + two * x * x),
        y * g + camera.p1 * (s + two * y * y) + two * camera.p2 * x * y,
    )


def rational_radius(camera: Rational, target: float) -> tuple[float, bool]:
    """The radius r within the domain with r g(r^2) = target >= 0, and whether there is one, by bisection. Newton's
    method in two dimensions starts from it."""
    limit = math.sqrt(camera.max_radius2)
    low = 0.0
    high = min(limit, 1.0)
    for _ in range(_MAX_BISECTIONS):
        if high >= limit or high * rational_factor(camera, high * high) >= target:
            break
        high = min(limit, 2.0 * high)
    reached = high * rational_factor(camera, high * high) >= target
    if not reached:  # also when the target is NaN
        return high, False
    for _ in range(_MAX_BISECTIONS):
        middle = 0.5 * (low + high)
        if middle * rational_factor(camera, middle * middle) >= target:
            high = middle
        else:
            low = middle
    return high, high < limit


def image_point(camera: Rational, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel of a point in the camera frame, and whether the point is in the domain."""
    one = like(1.0, z)
    in_front = z > like(0.0, z)
    inverse_z = one / (z if in_front else one)
    mx = x * inverse_z
    my = y * inverse_z
    in_domain = in_front & (mx * mx + my * my < camera.max_radius2)
    dx, dy = rational_distort(camera, mx if in_domain else like(0.0, z), my if in_domain else like(0.0, z))
    return camera.fx * dx + camera.cx, camera.fy * dy + camera.cy, in_domain


def unproject_point(camera: Rational, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray in the camera frame of a pixel, and whether the pixel is the image of a point in the domain."""
    xd = (u - camera.cx) / camera.fx
    yd = (v - camera.cy) / camera.fy
    distorted_radius = math.sqrt(xd * xd + yd * yd)
    # Beyond the radial limit the tangential part may still lead back inside, so start from the limit then.
    radius, _ = rational_radius(camera, distorted_radius)
    scale = radius / distorted_radius if distorted_radius > 0.0 else 1.0
    x = xd * scale
    y = yd * scale
    for _ in range(_MAX_STEPS):
        s = x * x + y * y
        g = rational_factor(camera, s)
        slope = 2.0 * rational_slope(camera, s)
        ex = x * g + 2.0 * camera.p1 * x * y + camera.p2 * (s + 2.0 * x * x) - xd
        ey = y * g + camera.p1 * (s + 2.0 * y * y) + 2.0 * camera.p2 * x * y - yd
        jxx = g + x * x * slope + 2.0 * camera.p1 * y + 6.0 * camera.p2 * x
        jxy = x * y * slope + 2.0 * camera.p1 * x + 2.0 * camera.p2 * y
        jyy = g + y * y * slope + 6.0 * camera.p1 * y + 2.0 * camera.p2 * x
        determinant = jxx * jyy - jxy * jxy
        if not abs(determinant) > 0.0:
            break
        dx = (jyy * ex - jxy * ey) / determinant
        dy = (jxx * ey - jxy * ex) / determinant
        x -= dx
        y -= dy
        if abs(dx) + abs(dy) <= 1e-16 * (abs(x) + abs(y)):
            break
    xr, yr = rational_distort(camera, x, y)
    allowed = _TOLERANCE * (1.0 + distorted_radius)
    close = (abs(xr - xd) < allowed) & (abs(yr - yd) < allowed)
    return guarded_ray(x, y, 1.0, close & (x * x + y * y < camera.max_radius2))


HELPERS = (rational_distort, rational_factor, rational_radius, rational_slope)
"""What the formulas call beside `base`; compiled with them."""
