"""How far the optimum really reaches along each principal axis of its covariance.

A covariance describes a hill only at its top. A ridge stays flat where a paraboloid with the same top has fallen, and
the optimum may lie anywhere on it. So the hill is walked down until its drop is certain; how wide it counts follows
from how certain the drop is on the way.
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
where the walk ends. It goes on beyond the first because a certain drop may be a dent in a ridge that goes on behind
it."""

ABOUT = 0.25
"""How well a certainty is known where a drop becomes certain: its unit is a standard deviation that some twenty sectors
determine to a sixth, 1 / √(2·19). A place whose certainty is nearer than that to `CERTAIN` counts in part."""

FIRST, DOUBLINGS = 4.0, 5
"""The walk begins this many standard deviations away, and the distance doubles this often, up to 128; on most hills the
walk ends at 8 or 16."""

STRAIGHT = 1e-6
"""Certainties that differ by less count as equal."""


def widened(landscape: Landscape, noise: Noise) -> list[list[float]]:
    """The covariance (n, n) of the noise, with each principal axis lengthened as much as the hill is wider there than a
    paraboloid. The width is where the drop becomes certain, root mean square of both sides. No axis gets shorter."""
    scale = of_both(1.0)[list(landscape.moved)].tolist()
    n = range(len(scale))
    scaled = [[noise.covariance[i][j] / scale[i] / scale[j] for j in n] for i in n]
    wide = [row[:] for row in noise.covariance]
    axes = [
        [sqrt(max(variance, 0.0)) * part * of for part, of in zip(direction, scale, strict=True)]
        for variance, direction in eigen(scaled)
    ]
    both_sides = _reaches(landscape, np.array([[axis, np.negative(axis)] for axis in axes]).reshape(-1, len(scale)))
    for axis, ahead, behind in zip(axes, both_sides[::2], both_sides[1::2], strict=True):
        more = max(0.5 * (ahead**2 + behind**2) / _expected(noise, axis) ** 2 - 1.0, 0.0)
        wide = [[wide[i][j] + more * axis[i] * axis[j] for j in n] for i in n]
    return wide


def _expected(noise: Noise, axis: list[float]) -> float:
    """How many lengths of an axis (n,) away the drop of a paraboloid becomes certain: three if the axis is also a
    principal axis of the hill."""
    n = range(len(axis))
    pull = [fsum(noise.information[i][j] * axis[j] for j in n) for i in n]
    ((scatter,),) = congruent([pull], noise.covariance)
    return 2.0 * CERTAIN * sqrt(scatter) / fsum(a * b for a, b in zip(pull, axis, strict=True))


def _reaches(landscape: Landscape, one_sigma: NDArray[np.float64]) -> list[float]:
    """Along each of m ways, over how many standard deviations the drop is not certain; one standard deviation is an
    offset of `one_sigma` (m, n). On a ridge with dents all of it counts except the dents. A slightly surer drop makes
    the reach slightly shorter."""
    reaches, walking = [0.0] * len(one_sigma), list(range(len(one_sigma)))
    before, certainties_before = 0.0, [0.0] * len(one_sigma)
    distance = FIRST
    for _ in range(DOUBLINGS + 1):
        going_on = []
        for way, cells in zip(walking, landscape.at(distance * one_sigma[walking]), strict=True):
            certainty = landscape.certainty(cells)
            reaches[way] += (distance - before) * _share_open(certainties_before[way], certainty)
            certainties_before[way] = certainty
            if certainty < BEYOND_DOUBT:
                going_on.append(way)
        if not going_on:
            break
        walking, before = going_on, distance
        distance *= 2.0
    return reaches


def _share_open(begin: float, end: float) -> float:
    """The share of the places between two where the optimum may lie because the drop is not certain. The certainty goes
    from `begin` to `end` in a straight line."""
    if abs(end - begin) < STRAIGHT:
        return min(max((CERTAIN + ABOUT - 0.5 * (begin + end)) / (2.0 * ABOUT), 0.0), 1.0)
    return (_open_up_to(end) - _open_up_to(begin)) / (end - begin)


def _open_up_to(certainty: float) -> float:
    """The integral over certainties of a share that is 1 while a drop is uncertain and falls to 0 about `CERTAIN`."""
    falling = min(max(certainty - (CERTAIN - ABOUT), 0.0), 2.0 * ABOUT)
    return min(certainty, CERTAIN + ABOUT) - falling * falling / (4.0 * ABOUT)
