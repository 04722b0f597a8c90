"""How far the optimum really reaches along each principal axis of its covariance.

A covariance is the shape of a hill at its top. A ridge is flat where the hill of the same top would have fallen, and on
it the optimum may lie anywhere: so the hill is walked down until its drop is certain.
"""

from __future__ import annotations

from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.landscape import Landscape
from coec.calibration.confidence.noise import Noise
from coec.calibration.steps import of_both
from coec.geometry.linear import congruent, eigen

CERTAIN, BEYOND_DOUBT = 1.5, 3.0
"""Certainty of a drop (`Landscape.certainty`) at three standard deviations of the optimum, on a paraboloid, and at six,
where the walk ends: a drop that is certain may be a dent in a ridge that goes on behind it."""

FIRST, DOUBLINGS = 4.0, 5
"""The walk begins so many standard deviations away and doubles so often, up to 128; on most hills it ends at 8 or
16."""


def widened(landscape: Landscape, noise: Noise) -> list[list[float]]:
    """The covariance (n, n) of the noise, each of its principal axes longer by as much as the hill is wider there than
    a paraboloid: by where its drop becomes certain, in the root mean square of both sides. Never shorter than it
    was."""
    scale = of_both(1.0)[list(landscape.moved)].tolist()
    n = range(len(scale))
    scaled = [[noise.covariance[i][j] / scale[i] / scale[j] for j in n] for i in n]
    wide = [row[:] for row in noise.covariance]
    for variance, direction in eigen(scaled):
        axis = [sqrt(max(variance, 0.0)) * part * of for part, of in zip(direction, scale, strict=True)]
        ahead, behind = _reach(landscape, np.array(axis)), _reach(landscape, -np.array(axis))
        more = max(0.5 * (ahead**2 + behind**2) / _expected(noise, axis) ** 2 - 1.0, 0.0)
        wide = [[wide[i][j] + more * axis[i] * axis[j] for j in n] for i in n]
    return wide


def _expected(noise: Noise, axis: list[float]) -> float:
    """How many lengths of an axis (n,) away the drop of a paraboloid becomes certain: three where it is a principal
    axis of the hill, too."""
    n = range(len(axis))
    pull = [fsum(noise.information[i][j] * axis[j] for j in n) for i in n]
    ((scatter,),) = congruent([pull], noise.covariance)
    return 2.0 * CERTAIN * sqrt(scatter) / fsum(a * b for a, b in zip(pull, axis, strict=True))


def _reach(landscape: Landscape, one_sigma: NDArray[np.float64]) -> float:
    """How many standard deviations away the drop along an offset (n,) of one of them becomes certain for good."""
    reach, before, certainty_before = 0.0, 0.0, 0.0
    distance = FIRST
    for _ in range(DOUBLINGS + 1):
        certainty = landscape.certainty(landscape.at(distance * one_sigma))
        if certainty < CERTAIN:
            reach = distance
        elif certainty_before < CERTAIN:
            share = (CERTAIN - certainty_before) / (certainty - certainty_before)
            reach = before + share * (distance - before)
        if certainty >= BEYOND_DOUBT:
            break
        before, certainty_before = distance, certainty
        distance *= 2.0
    return reach
