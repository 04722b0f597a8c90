"""Quantiles of the distributions that limits are taken from."""

from __future__ import annotations

from math import sqrt
from statistics import NormalDist


def chi2_quantile(probability: float, dof: int) -> float:
    """Of the χ² distribution, by the cube-root approximation of Wilson and Hilferty (1931): within 3 % from one degree
    of freedom and 0.9 on.

    Raises:
        ValueError: the probability is not between 0 and 1.
    """
    h = 2.0 / (9.0 * dof)
    return dof * (1.0 - h + normal_quantile(probability) * sqrt(h)) ** 3


def normal_quantile(probability: float) -> float:
    """Of the standard normal distribution.

    Raises:
        ValueError: the probability is not between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"a quantile needs a probability between 0 and 1, got {probability}")
    return NormalDist().inv_cdf(probability)
