"""Radial and tangential distortion of normalised image coordinates, as in OpenCV's `projectPoints`.

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971, in OpenCV's notation.
"""

import math

from coec.geometry.cameras.formulas import like
from coec.geometry.cameras.polynomial import odd_polynomial, solve_odd_polynomial

# Newton's method converges quadratically from the radial solution; real lenses need three to five steps.
_MAX_NEWTON_STEPS = 30
# Largest distance between a pixel and the re-distorted solution for the pixel to have a ray. Normalised coordinates:
# 1e-9 of a focal length, a millionth of a pixel.
_TOLERANCE = 1e-9


def distort(k1: float, k2: float, p1: float, p2: float, k3: float, x: float, y: float) -> tuple[float, float]:
    """Distorted normalised coordinates of (x, y)."""
    two = like(2.0, x)
    r2 = x * x + y * y
    radial = like(1.0, x) + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + two * p1 * x * y + p2 * (r2 + two * x * x),
        y * radial + p1 * (r2 + two * y * y) + two * p2 * x * y,
    )


def undistort(
    k1: float, k2: float, p1: float, p2: float, k3: float, max_radius2: float, xd: float, yd: float
) -> tuple[float, float, bool]:
    """The (x, y) within max_radius2 that `distort` maps to (xd, yd), and whether there is one.

    Starts at the solution without the tangential part and ends with Newton's method in two dimensions.
    """
    limit = math.sqrt(max_radius2)
    distorted_radius = math.sqrt(xd * xd + yd * yd)
    radius, converged = solve_odd_polynomial(k1, k2, k3, 0.0, distorted_radius, limit)
    if not converged:  # beyond the radial limit, where the tangential part may still reach back inside
        radius = limit if limit < math.inf else distorted_radius
        converged = odd_polynomial(k1, k2, k3, 0.0, radius) > 0.0
    scale = radius / distorted_radius if distorted_radius > 0.0 else 1.0
    x = xd * scale
    y = yd * scale
    for _ in range(_MAX_NEWTON_STEPS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        radial_slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d radial / d(r^2), doubled
        ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
        ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
        jxx = radial + x * x * radial_slope + 2.0 * p1 * y + 6.0 * p2 * x
        jxy = x * y * radial_slope + 2.0 * p1 * x + 2.0 * p2 * y
        jyy = radial + y * y * radial_slope + 6.0 * p1 * y + 2.0 * p2 * x
        determinant = jxx * jyy - jxy * jxy
        if not abs(determinant) > 0.0:
            break
        dx = (jyy * ex - jxy * ey) / determinant
        dy = (jxx * ey - jxy * ex) / determinant
        x -= dx
        y -= dy
        if abs(dx) + abs(dy) <= 1e-16 * (abs(x) + abs(y)):
            break
    xr, yr = distort(k1, k2, p1, p2, k3, x, y)
    close = (abs(xr - xd) < _TOLERANCE * (1.0 + distorted_radius)) & (
        abs(yr - yd) < _TOLERANCE * (1.0 + distorted_radius)
    )
    return x, y, converged & close & (x * x + y * y < max_radius2)
