"""A pose once more, with what was taken as known set free: does the window contradict what it was told?

A camera's centre that was held, clocks that were believed and a lens that was taken from a sheet all leave a pattern in
the residuals that no pose takes away. Each is set free in turn, after the ones before it: the centre, then the clocks,
then the lens (a nested likelihood ratio, Wilks 1938, on the sharpest edges). What is gained is counted against how
frames and sectors of the image scatter; what the pose moves by meanwhile is what it was led astray by.

The free ones move along with the pose that answers them: a principal point further right is a camera turned to the
left, on most of the image, and what is left after the turn is what the window can tell of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.landscape import certainty
from coec.calibration.confidence.told import CLOCKS, LENS, REACH, SHIFTS, SIZE, Told, moves, told
from coec.calibration.objective.cells import COLUMNS, ROWS, sectors
from coec.calibration.search.bounded import Box, maximum_in
from coec.calibration.types import Matrix4, Window
from coec.geometry import se3
from coec.geometry.edges.alignment import LEAST_SQUARE, EdgeFrames, frame_alignment
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, SHARP_SIGMA_PX
from coec.geometry.linear import solved

HELD_FREE, CLOCKS_FREE, LENS_FREE = "held_free", "clocks_free", "lens_free"
"""Names of what is set free."""

POINTS = 12_000
"""Range edges that are asked, at most: hundreds of evaluations of them cost as much as ten of the search's."""

CERTAIN = 1.25
"""Certainty (`landscape.certainty`) from which a gain is believed: two and a half standard deviations on a
paraboloid."""

LEAST_PX = 0.4
"""What is set free must move the sharpest edges by so much, root mean square, beside what the pose can do: less leaves
the pose where it was. In 48 windows of twelve simulated drives that were told the truth no gain was as certain and as
large; in all 24 of six others, with clocks, a lens or a shutter off, one was."""

LEADING, SETTLING = 0.1, 0.03
"""Shares of its first step within which a climb ends, on a level that leads to the next and on the sharpest. An offset
of the clocks and a shift along the way differ by little: its hill is a ridge."""

MAX_EVALUATIONS = 200
"""Bound on one climb; it takes 20 to 80."""

SHARP_STEP_PX = 2.0 * SHARP_SIGMA_PX
"""First step on the sharpest edges: their hill is as wide."""


@dataclass(frozen=True, slots=True, eq=False)
class Loosened:
    """What setting something free came to.

    Attributes:
        name: of what was set free.
        certainty: of the gain; see `Landscape.certainty`.
        moved_px: what it moves the edges by beside what the pose can do, root mean square, pixels of the sharpest map.
        deviation: (12,) from what was told, with what was set free before it; see `told`.
        shift: (6,) by how much the pose turned and shifted meanwhile, rad and m.
    """

    name: str
    certainty: float
    moved_px: float
    deviation: NDArray[np.float64]
    shift: NDArray[np.float64]

    @property
    def contradicts(self) -> bool:
        """Whether the window contradicts what it was told."""
        return self.certainty >= CERTAIN and self.moved_px >= LEAST_PX


def loosen(edges: Sequence[EdgeFrames], window: Window, pose: Matrix4, held: Sequence[int]) -> tuple[Loosened, ...]:
    """What was taken as known, set free, one after the other; empty where the edges in view do not determine a pose.

    Args:
        edges: of the window, from a level that leads there to the sharpest one.
        window: it was solved to `pose` (4, 4), at the end of its search.
        held: the translations (places in ξ) that were taken as known.
    """
    levels = [told(level, window, pose, POINTS) for level in edges]
    free = [(HELD_FREE, tuple(held))] if held else []
    if moves(window):
        free.append((CLOCKS_FREE, tuple(CLOCKS)))
    free.append((LENS_FREE, tuple(LENS)))
    base = tuple(axis for axis in range(SHIFTS.stop) if axis not in held)
    try:
        before = _climbed(levels[-1:], _Ways.of(levels[-1], np.zeros(SIZE), base, ()), np.zeros(SIZE))
        found = []
        for name, places in free:
            ways = _Ways.of(levels[-1], before, base, places)
            after = _climbed(levels, ways, before)
            found.append(_judged(name, levels[-1], ways, before, after))
            base, before = (*base, *places), after
    except ValueError:
        return ()
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Ways:
    """The directions of a climb, n of them.

    Attributes:
        directions: (12, n) of a deviation: what moves by itself, and what is set free with its answer.
        steps: (n,) along each of them that move the edges by one pixel of the sharpest map.
        free: places of what is set free.
        residual: (f, f) mean products of what the f free ones move the edges by beside their answers, px².
    """

    directions: NDArray[np.float64]
    steps: NDArray[np.float64]
    free: tuple[int, ...]
    residual: NDArray[np.float64]

    @classmethod
    def of(cls, sharp: Told, at: NDArray[np.float64], base: tuple[int, ...], free: tuple[int, ...]) -> _Ways:
        """About a deviation (12,): `base` moves already, `free` is set free.

        Raises:
            ValueError: the edges in view do not determine what moves already.
        """
        places, count = (*base, *free), len(base)
        columns, seen = sharp.moved(at, places)
        weight = np.where(seen, sharp.frames.weight, 0.0)[:, None]
        whole = max(float(weight.sum()), LEAST_SQUARE)
        n = range(len(places))
        weighted = columns * weight[:, :, None]
        # Sums without a BLAS product: to the bit the same in every process.
        normal = [[float(np.sum(weighted[:, :, i] * columns[:, :, j])) / whole for j in n] for i in n]
        own = [row[:count] for row in normal[:count]]
        directions = np.zeros((SIZE, len(places)))
        directions[places, n] = 1.0
        answers = [solved(own, [normal[i][j] for i in range(count)]) for j in range(count, len(places))]
        for column, answer in enumerate(answers, start=count):
            directions[list(base), column] = np.negative(answer)
        residual = [
            [normal[i][j] - fsum(a * normal[i][k] for k, a in enumerate(answers[j - count])) for j in n[count:]]
            for i in n[count:]
        ]
        squares = [normal[i][i] for i in range(count)] + [residual[k][k] for k in range(len(free))]
        return cls(directions, np.array([1.0 / sqrt(max(s, LEAST_SQUARE)) for s in squares]), free, np.array(residual))

    def moved_px(self, deviation: NDArray[np.float64]) -> float:
        """What the free ones of a deviation (12,) move the edges by, beside their answers."""
        values = deviation[list(self.free)].tolist()
        rows = self.residual.tolist()
        square = fsum(a * b * rows[i][j] for i, a in enumerate(values) for j, b in enumerate(values))
        return sqrt(max(square, 0.0))


def _climbed(levels: Sequence[Told], ways: _Ways, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """The deviation (12,) of the most significant alignment next to `start` (12,) on the last level, to which the ones
    before it lead."""
    sharpest = levels[-1].frames.camera.width
    reach = REACH[:, None] / np.maximum(np.abs(ways.directions), 1e-9)
    widest = 0.5 * reach.min(axis=0)
    at = start
    for level in levels:
        last = level is levels[-1]
        blur_px = SHARP_STEP_PX if last else BLUR_SIGMA_PX * sharpest / level.frames.camera.width
        step = np.minimum(blur_px * ways.steps, widest)
        begin = at

        def score(along: NDArray[np.float64], level: Told = level, begin: NDArray[np.float64] = begin) -> float:
            deviation = begin + np.sum(ways.directions * along, axis=1)
            # Half a deviation at the end of its reach: what the window does not tell stays as it was told.
            unlike = deviation[SHIFTS.stop :] / REACH[SHIFTS.stop :]
            return level.significance(deviation) - 0.5 * float(np.sum(unlike * unlike))

        box = Box(-2.0 * widest, 2.0 * widest, step, (SETTLING if last else LEADING) * step)
        found, _ = maximum_in(box, score, np.zeros(len(step)), MAX_EVALUATIONS)
        at = begin + np.sum(ways.directions * found, axis=1)
    return at


def _judged(name: str, sharp: Told, ways: _Ways, before: NDArray[np.float64], after: NDArray[np.float64]) -> Loosened:
    uv_px, seen = sharp.pixels(after)
    sector = np.full(len(uv_px), -1)
    sector[seen] = sectors(uv_px[seen])
    parts = [np.flatnonzero(sector == number) for number in range(COLUMNS * ROWS)]
    shift = se3.difference(sharp.otherwise(after)[1], sharp.otherwise(before)[1])
    gained = certainty(_cells(sharp, after, parts) - _cells(sharp, before, parts))
    return Loosened(name, gained, ways.moved_px(after - before), after, shift)


def _cells(sharp: Told, deviation: NDArray[np.float64], parts: Sequence[NDArray[np.int64]]) -> NDArray[np.float64]:
    """(F, B) what each frame adds to the significance in each part of the range edges."""
    frames, pose = sharp.otherwise(deviation)
    of_parts = [frame_alignment(frames.of_points(part), pose) for part in parts]
    square = float(np.sum([part.square for part in of_parts]))
    return np.stack([part.strength for part in of_parts], axis=1) / sqrt(max(square, LEAST_SQUARE))
