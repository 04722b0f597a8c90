"""What the formulas of all camera models share: guards, and an arc tangent that vectorises.

Plain Python on numbers, which `compiled` hands to numba as it is. What runs in loops over many points has no branches.
"""

import math
from typing import Protocol

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

    The formulas are compiled for float64, and for float32 where speed asks for it (`coec.geometry.pixel_lookup`). A
    bare constant is a float64 and would make a float64 of everything that it touches.
    """
    return constant


class _ImageSize(Protocol):
    """The fields that every camera model has and that the guards read."""

    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...


def guarded_pixel(
    camera: _ImageSize, x: float, y: float, z: float, u: float, v: float, in_domain: bool
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
