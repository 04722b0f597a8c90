"""How far the optimum really reaches along each axis of its covariance.

A covariance is the shape of a hill at its top. A ridge is flat where the hill of the same top would have fallen, and on
it the optimum may lie anywhere: so the hill is walked down until its drop is certain.
"""

from __future__ import annotations

from math import fsum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.landscape import Landscape
from coec.calibration.confidence.noise import Noise
from coec.geometry.linear import cholesky, congruent, eigen

CERTAIN = 1.5
"""Certainty of a drop at three standard deviations of the optimum, on a paraboloid (`Landscape.certainty`)."""

FIRST, DOUBLINGS = 4.0, 5
"""The walk begins so many standard deviations away and doubles so often, up to 128: most end at once."""


def widened(landscape: Landscape, noise: Noise) -> list[list[float]]:
    """The covariance (n, n) of the noise with each of its axes as long as the hill is wide: three standard deviations
    reach to where its drop is certain, in the root mean square of both sides. Never shorter than it was.

    The axes are those along which the covariance and the hill fall apart together, Σ = Σₖ dₖ·dₖᵀ with dₖᵀ·J·dₗ = 0: so
    that on a paraboloid each is as long as it was, in whatever units.
    """
    n = range(len(noise.covariance))
    factor = cholesky(noise.covariance)
    transposed = [[factor[k][i] for k in n] for i in n]
    wide = [row[:] for row in noise.covariance]
    for _, turned in eigen(congruent(transposed, noise.information)):
        axis = [fsum(factor[i][k] * turned[k] for k in n) for i in n]
        ahead, behind = _reach(landscape, np.array(axis)), _reach(landscape, -np.array(axis))
        more = max(0.5 * (ahead**2 + behind**2) / 9.0 - 1.0, 0.0)
        wide = [[wide[i][j] + more * axis[i] * axis[j] for j in n] for i in n]
    return wide


def _reach(landscape: Landscape, one_sigma: NDArray[np.float64]) -> float:
    """How many standard deviations away the drop along an offset (n,) of one of them becomes certain."""
    before, certainty_before = 0.0, 0.0
    distance = FIRST
    for _ in range(DOUBLINGS + 1):
        certainty = landscape.certainty(landscape.at(distance * one_sigma))
        if certainty >= CERTAIN:
            share = (CERTAIN - certainty_before) / (certainty - certainty_before)
            return before + share * (distance - before)
        before, certainty_before = distance, certainty
        distance *= 2.0
    return before
