"""Quantiles of the distributions from which limits are taken."""

from __future__ import annotations

from math import sqrt
from statistics import NormalDist


def chi2_quantile(probability: float, dof: int) -> float:
    """Quantile of the χ² distribution, by the cube-root approximation of Wilson and Hilferty (1931): within 3 % from
    one degree of freedom and a probability of 0.9 on.

    Raises:
        ValueError: the probability is not between 0 and 1.
    """
    h = 2.0 / (9.0 * dof)
    return dof * (1.0 - h + normal_quantile(probability) * sqrt(h)) ** 3


def poisson_most(confidence: float, events: int) -> float:
    """The mean of a Poisson variable that is `events` or fewer in one of 1 / (1 - confidence) draws: the upper
    confidence limit for a mean when so many events were seen (Garwood 1936).

    Raises:
        ValueError: the confidence is not between 0 and 1.
    """
    return 0.5 * chi2_quantile(confidence, 2 * (events + 1))


def distance2_quantile(probability: float, dof: int, known_by: int) -> float:
    """Quantile of the squared distance of one more draw in `dof` axes from a mean, in standard deviations that were
    estimated with `known_by` degrees of freedom: `dof` times the F distribution, by the approximation of Paulson
    (1942). If the estimate is from few draws, one more draw lies farther out than χ² says.

    Raises:
        ValueError: the probability is not between 0 and 1, or `known_by` is too small for so rare a quantile.
    """
    z = normal_quantile(probability)
    g, h = 2.0 / (9.0 * dof), 2.0 / (9.0 * known_by)
    a, b = 1.0 - h, 1.0 - g
    left = a * a - z * z * h
    if left <= 0.0:
        raise ValueError(f"{known_by} degrees of freedom determine no quantile of {probability}")
    root = (a * b + sqrt(a * a * b * b - left * (b * b - z * z * g))) / left
    return dof * root**3


def normal_quantile(probability: float) -> float:
    """Quantile of the standard normal distribution.

    Raises:
        ValueError: the probability is not between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"a quantile needs a probability between 0 and 1, got {probability}")
    return NormalDist().inv_cdf(probability)
