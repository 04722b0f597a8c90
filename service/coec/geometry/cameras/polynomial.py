"""The odd polynomial t (1 + c1 t^2 + c2 t^4 + c3 t^6 + c4 t^8) of radial distortion: up to where it grows, and its
inverse."""

import math

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras.formulas import like

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
            raise ValueError("the distortion coefficients are of too different sizes")
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
