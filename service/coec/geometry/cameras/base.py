"""What the camera models share: checks of their numbers, guards of the formulas, an arc tangent that vectorises, the
odd polynomial of radial distortion with its inverse, and the radial and tangential distortion of normalised image
coordinates as in OpenCV's `projectPoints`.

Plain Python on numbers, which `compiler` hands to numba as it is. What runs in loops over many points has no
branches.

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37(8), 1971, in OpenCV's notation.
"""

import math
from numbers import Integral, Real
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

# A pixel further out than this is on no sensor; the bound keeps every coordinate inside int32. Unit: px.
MAX_PIXEL_PX = 1e9

# No valid point is nearer than a nanometre or farther than a million kilometres; far beyond, squares would underflow or
# overflow. Units: m, m^2.
MAX_RANGE_M = 1e9
MIN_RANGE2_M2 = 1e-18
MAX_RANGE2_M2 = MAX_RANGE_M**2

_TAN_PI_8 = math.sqrt(2.0) - 1.0

# atan(t) = t p(t^2) on |t| <= tan(pi/8): p interpolates atan(sqrt(s))/sqrt(s) at the Chebyshev nodes of
# 0 <= s <= tan(pi/8)^2, 11 of them (solved with 50 digits). Largest error 7e-17, below the rounding of a float64.
_A1, _A2, _A3 = -0.3333333333332844, 0.199999999988551, -0.1428571418097571
_A4, _A5, _A6 = 0.11111106180425145, -0.09090773074092884, 0.07689953486227682
_A7, _A8, _A9, _A10 = -0.06640233842869744, 0.056883487686028446, -0.04348050891958043, 0.02113535694575133


def like(constant: float, value: float) -> float:  # noqa: ARG001  (only its type counts)
    """The constant in the precision of the value.

    The formulas are compiled for float64, and for float32 where speed asks for it (`coec.geometry.projection`). A
    bare constant is a float64 and would make a float64 of everything that it touches.
    """
    return constant


class CameraFields(Protocol):
    """The fields that every camera model has."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...


def guarded_pixel(
    camera: CameraFields, x: float, y: float, z: float, u: float, v: float, in_domain: bool
) -> tuple[float, float, bool]:
    """(u, v, True) for a point (x, y, z) in the domain with a sane pixel, else the principal point and False."""
    range2 = x * x + y * y + z * z
    valid = in_domain & (range2 > MIN_RANGE2_M2) & (range2 < MAX_RANGE2_M2)  # false for NaN
    valid &= (abs(u) < MAX_PIXEL_PX) & (abs(v) < MAX_PIXEL_PX)
    return (u if valid else camera.cx), (v if valid else camera.cy), valid


def guarded_ray(x: float, y: float, z: float, in_domain: bool) -> tuple[float, float, float, bool]:
    """The unit vector along (x, y, z) and True, else the optical axis and False."""
    norm2 = x * x + y * y + z * z
    valid = in_domain & (norm2 > MIN_RANGE2_M2) & (norm2 < MAX_RANGE2_M2)  # false for NaN
    scale = 1.0 / math.sqrt(norm2 if valid else 1.0)
    return (x * scale if valid else 0.0), (y * scale if valid else 0.0), (z * scale if valid else 1.0), valid


def arc_over_tangent(s: float) -> float:
    """atan(t)/t from s = t^2."""
    p = _A5 + s * (_A6 + s * (_A7 + s * (_A8 + s * (_A9 + s * _A10))))
    return 1.0 + s * (_A1 + s * (_A2 + s * (_A3 + s * (_A4 + s * p))))


def polar_angle(radius: float, z: float) -> float:
    """atan2(radius, z) for radius >= 0, in [0, pi], without a branch or a library call: a loop over it vectorises.

    Largest error against math.atan2: 4e-16 rad. Any finite value for (0, 0).
    """
    depth = abs(z)
    steep = radius > depth
    small = depth if steep else radius
    large = radius if steep else depth
    # Past tan(pi/8) measure from the diagonal instead: atan(s/l) = pi/4 + atan((s - l)/(s + l)).
    diagonal = small > like(_TAN_PI_8, z) * large
    numerator = small - large if diagonal else small
    denominator = small + large if diagonal else large
    zero, one = like(0.0, z), like(1.0, z)
    t = numerator / (denominator if denominator > zero else one)
    s = t * t
    angle = (like(0.25 * math.pi, z) if diagonal else zero) + t * arc_over_tangent(s)
    angle = like(0.5 * math.pi, z) - angle if steep else angle
    return like(math.pi, z) - angle if z < zero else angle


class CommonIntrinsics(NamedTuple):
    """The checked fields that all models share, in the order in which all models start."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


def finite(name: str, value: float) -> float:
    """`value` as a float; ValueError unless it is a finite number."""
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    return float(value)


def positive(name: str, value: float) -> float:
    """`value` as a float; ValueError unless it is finite and above zero."""
    if not finite(name, value) > 0.0:
        raise ValueError(f"{name} must be above zero, got {value!r}")
    return float(value)


def within(name: str, value: float, low: float, high: float) -> float:
    """`value` as a float; ValueError unless low <= value <= high."""
    if not low <= finite(name, value) <= high:
        raise ValueError(f"{name} must lie in [{low:g}, {high:g}], got {value!r}")
    return float(value)


def pixel_count(name: str, value: int) -> int:
    """`value` as an int; ValueError unless it is a whole number above zero."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value <= 0:
        raise ValueError(f"{name} must be a whole number of pixels above zero, got {value!r}")
    return int(value)


def common_intrinsics(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> CommonIntrinsics:
    """The checked size (px), focal lengths (px, above zero) and principal point (px, any finite value)."""
    return CommonIntrinsics(
        pixel_count("width", width),
        pixel_count("height", height),
        positive("fx", fx),
        positive("fy", fy),
        finite("cx", cx),
        finite("cy", cy),
    )


# Newton's method halves its bracket when a step fails, so that it gains at least a bit per step: 52 steps for a
# float64, and the doublings that find the bracket.
_MAX_STEPS = 100


def monotonic_limit_squared(coefficients: tuple[float, ...]) -> float:
    """Square of the smallest t > 0 at which t (1 + c1 t^2 + c2 t^4 + ...) stops growing; infinite if it never does.

    There the derivative 1 + 3 c1 s + 5 c2 s^2 + ..., s = t^2, has its first positive root of odd order. Beyond it two
    radii share a pixel, so the model has no meaning there.
    """
    return first_positive_root(np.array([1.0, *((2 * i + 3) * c for i, c in enumerate(coefficients))]))


def first_positive_root(polynomial: NDArray[np.float64]) -> float:
    """The smallest s > 0 at which a polynomial, its coefficients (N,) ascending, is zero; infinite if there is none.
    Raises ValueError if a double cannot hold the ratio of two coefficients, which no real lens has."""
    trimmed = np.trim_zeros(polynomial, "b")
    with np.errstate(over="ignore", invalid="ignore"):
        if not np.isfinite(trimmed / trimmed[-1]).all():
            raise ValueError("the magnitudes of the distortion coefficients differ too much")
    roots = np.polynomial.polynomial.polyroots(trimmed)
    # A root counts as real if its imaginary part is rounding only (eigenvalues of the companion matrix, relative).
    real = np.sort(roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)])
    return float(real[0]) if real.size else math.inf


def odd_polynomial(c1: float, c2: float, c3: float, c4: float, t: float) -> float:
    """t (1 + c1 t^2 + c2 t^4 + c3 t^6 + c4 t^8)."""
    s = t * t
    return t * (like(1.0, t) + s * (c1 + s * (c2 + s * (c3 + s * c4))))


def solve_odd_polynomial(c1: float, c2: float, c3: float, c4: float, target: float, limit: float) -> tuple[float, bool]:
    """The t in [0, limit) with odd_polynomial(t) = target >= 0, and whether there is one.

    The polynomial must grow on [0, limit) (see `monotonic_limit_squared`); limit may be infinite. Newton's method
    inside a bracket that shrinks by bisection wherever Newton leaves it.
    """
    low = 0.0
    high = min(limit, 1.0)
    for _ in range(_MAX_STEPS):
        if high >= limit or odd_polynomial(c1, c2, c3, c4, high) >= target:
            break
        high = min(limit, 2.0 * high)
    if not odd_polynomial(c1, c2, c3, c4, high) >= target:  # also when the target is NaN
        return 0.0, False
    t = min(target, high)
    for _ in range(_MAX_STEPS):
        s = t * t
        residual = odd_polynomial(c1, c2, c3, c4, t) - target
        slope = 1.0 + s * (3.0 * c1 + s * (5.0 * c2 + s * (7.0 * c3 + s * 9.0 * c4)))
        if residual > 0.0:
            high = t
        else:
            low = t
        step = residual / slope if slope > 0.0 else math.inf
        proposed = t - step
        following = proposed if low < proposed < high else 0.5 * (low + high)
        if abs(following - t) <= 1e-16 * t:
            break
        t = following
    return t, t < limit


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
