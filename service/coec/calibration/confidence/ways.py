"""Climbs of the alignment of range edges over a pose and over the assumptions of a window (clocks, lens).

An assumption that is set free moves together with the pose that answers it. For example, a principal point further
right looks on most of the image like a camera turned to the left; only what the turn does not explain shows the
principal point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.told import REACH, SHIFTS, SIZE, AssumedEdges
from coec.calibration.search.bounded import Box, maximum_in
from coec.geometry.edges.alignment import LEAST_SQUARE
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, SHARP_SIGMA_PX
from coec.geometry.linear import inverted

LEADING, SETTLING = 0.1, 0.03
"""A climb ends within this share of its first step, on a level that leads to the next one and on the sharpest. The
second is small because the hill is a ridge: an offset of the clocks and a shift along the way differ by little."""

POINTS = 5_000
"""Most range edges from which the directions are computed: least squares over twelve unknowns needs no more."""

MAX_EVALUATIONS = 200
"""Bound on one climb; it takes 20 to 80."""

LATTICE = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Where further climbs may begin along a ridge, in halves of its reach."""

BEGINS = 2
"""Climbs from such a lattice, of some 15 ms each. Where what was assumed is right, one of them begins there."""

SHARP_STEP_PX = 2.0 * SHARP_SIGMA_PX
"""First step on the sharpest edges, as wide as their hill."""


@dataclass(frozen=True, slots=True, eq=False)
class ParameterSubset:
    """The directions of a climb, n of them.

    Attributes:
        directions: (12, n) in the space of deviations: of what moves by itself, and of what is set free together with
            the answer of the pose.
        steps: (n,) along each direction that move the edges by one pixel of the sharpest map.
        free: places of what is set free.
        residual: (f, f) mean products of how the f free ones still move the edges after their answers, px².
    """

    directions: NDArray[np.float64]
    steps: NDArray[np.float64]
    free: tuple[int, ...]
    residual: NDArray[np.float64]

    @classmethod
    def of(
        cls, sharp: AssumedEdges, at: NDArray[np.float64], base: tuple[int, ...], free: tuple[int, ...]
    ) -> ParameterSubset:
        """The directions about a deviation (12,): the places `base` move already, the places `free` are set free.

        Raises:
            ValueError: the edges in view do not determine `base`.
        """
        places, count = (*base, *free), len(base)
        some = sharp.thinned(POINTS)
        columns, seen = some.moved(at, places)
        weight = np.where(seen, some.frames.weight, 0.0)[:, None]
        whole = max(float(weight.sum()), LEAST_SQUARE)
        n = range(len(places))
        normal = [[0.0] * len(places) for _ in n]
        for i in n:
            weighted = columns[i] * weight
            for j in range(i + 1):
                # A sum without a BLAS product is the same to the bit in every process.
                normal[i][j] = normal[j][i] = float(np.sum(weighted * columns[j])) / whole
        own = [row[:count] for row in normal[:count]]
        directions = np.zeros((SIZE, len(places)))
        directions[places, n] = 1.0
        inverse = inverted(own)
        answers = [[fsum(a * normal[k][j] for k, a in enumerate(row)) for row in inverse] for j in n[count:]]
        for column, answer in enumerate(answers, start=count):
            directions[list(base), column] = np.negative(answer)
        residual = [
            [normal[i][j] - fsum(a * normal[i][k] for k, a in enumerate(answers[j - count])) for j in n[count:]]
            for i in n[count:]
        ]
        squares = [normal[i][i] for i in range(count)] + [residual[k][k] for k in range(len(free))]
        return cls(directions, np.array([1.0 / sqrt(max(s, LEAST_SQUARE)) for s in squares]), free, np.array(residual))

    @property
    def widest(self) -> NDArray[np.float64]:
        """(n,) half the reach of each direction."""
        reach = REACH[:, None] / np.maximum(np.abs(self.directions), 1e-9)
        return np.asarray(0.5 * reach.min(axis=0))

    def combined(self, along: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, 12) the deviations of K moves (K, n) along the directions."""
        return np.asarray(np.sum(self.directions * along[:, None, :], axis=2))

    def lattice(self, places: Sequence[int], about: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K, 12) the deviations at which some of the free places, with their answers, are off from `about` (12,) by
        each combination of `LATTICE`."""
        columns = len(self.steps) - len(self.free) + np.array([self.free.index(place) for place in places])
        along = np.zeros((len(LATTICE) ** len(places), len(self.steps)))
        along[:, columns] = self.widest[columns] * list(product(LATTICE, repeat=len(places)))
        return about + self.combined(along)

    def moved_px(self, deviation: NDArray[np.float64]) -> float:
        """By how many pixels the free places of a deviation (12,) still move the edges after their answers."""
        values = deviation[list(self.free)].tolist()
        rows = self.residual.tolist()
        square = fsum(a * b * rows[i][j] for i, a in enumerate(values) for j, b in enumerate(values))
        return sqrt(max(square, 0.0))


def local_ascent(
    levels: Sequence[AssumedEdges], subset: ParameterSubset, start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The deviation (12,) of the most significant alignment on the last level next to `start` (12,). The levels before
    it lead there."""
    sharpest, widest = levels[-1].frames.camera.width, subset.widest
    at = start
    for level in levels:
        last = level is levels[-1]
        blur_px = SHARP_STEP_PX if last else BLUR_SIGMA_PX * sharpest / level.frames.camera.width
        step = np.minimum(blur_px * subset.steps, widest)
        begin = at

        def scores(
            points: NDArray[np.float64], level: AssumedEdges = level, begin: NDArray[np.float64] = begin
        ) -> list[float]:
            values: list[float] = _scores(level, begin + subset.combined(points)).tolist()
            return values

        box = Box(-2.0 * widest, 2.0 * widest, step, (SETTLING if last else LEADING) * step)
        best, _ = maximum_in(box, scores, np.zeros(len(step)), MAX_EVALUATIONS)
        at = begin + subset.combined(best[None])[0]
    return at


def ends_along(
    places: Sequence[int], levels: Sequence[AssumedEdges], subset: ParameterSubset, start: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """The deviations (12,) at which climbs from about `start` (12,) end; `places` are those of the free ones that the
    pose answers almost entirely. They make a long ridge, whose dents hold a climb: beside the one that the levels lead,
    others begin on the last level, at the best points of a lattice of these places. Without such places there is one.
    """
    led = local_ascent(levels, subset, start)
    if not places:
        return [led]
    lattice = subset.lattice(places, start)
    best = np.argsort(-_scores(levels[-1], lattice), kind="stable")[:BEGINS]
    return [led, *(local_ascent(levels[-1:], subset, lattice[k]) for k in best)]


def _scores(level: AssumedEdges, deviations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) what a climb makes large, at each of K deviations (K, 12). It costs half a unit at the end of the reach, so
    that what the window does not show stays as assumed."""
    unlike = deviations[:, SHIFTS.stop :] / REACH[SHIFTS.stop :]
    return np.asarray(level.significances(deviations) - 0.5 * np.sum(unlike * unlike, axis=1))
