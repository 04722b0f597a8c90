"""How far an optimum may be off, all in all: by chance (the sandwich covariance J⁻¹·V·J⁻¹, Huber 1967), by ridges that
are wider than their top, by other modes, by errors that all frames share, and by assumptions that the window itself
contradicts.

It is the sandwich of maximum-likelihood theory (Huber 1967), J⁻¹·V·J⁻¹, with V from the scatter of the score between
frames and between sectors of the image. Both are needed: all frames of a standing vehicle show the same and so agree on
anything, but its sectors, which show different things, do not; and a wrong lens acts on a sector in every frame alike.

A covariance describes a hill only at its top. A ridge stays flat where a paraboloid with the same top has fallen, and
the optimum may lie anywhere on it. So the hill is walked down until its drop is certain; how wide it counts follows
from how certain the drop is on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import fsum, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.derivatives import across, along
from coec.calibration.objective.mutual_information import Divisible
from coec.calibration.search.prior import of_both
from coec.calibration.types import Matrix4, Uncertainty, Window
from coec.calibration.uncertainty.modes import Rivals, with_modes
from coec.calibration.uncertainty.nuisance_parameters import RelaxedAssumption
from coec.calibration.uncertainty.scatter import Landscape, scatter
from coec.calibration.uncertainty.systematic import sensor_resolution, systematic_shifts
from coec.geometry.linalg import Rows, congruent, eigen, inverted

WIDER = (1.0, 2.0, 4.0)
"""Difference steps, in steps of the cells, that are tried until the objective has a maximum: a ripple may dent the top
of a hill."""

SAME = 1e-9
"""If frames differ, the smallest axis of the scatter has at least this share of the largest, with each figure in units
of its standard deviation. Frames that repeat one another leave 1e-16, the rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """The spread of an optimum by chance.

    Attributes:
        covariance: (n, n) of the axes that were searched, radians and metres.
        information: (n, n) negative Hessian of the objective, likewise.
        looks: how many independent looks the frames are worth for the place of the optimum: as many as there are, if
            what a frame says of a sector is independent of the other frames; one, if all say the same. How often they
            say that this is the right hill is another question: see `confidence.looks`.
    """

    covariance: list[list[float]]
    information: list[list[float]]
    independent_samples: float


def measure_noise(landscape: Landscape) -> Noise | None:
    """The noise, by central differences. None if the objective has no maximum, or if too few frames differ: two views
    in turn, however often, scatter along one line and would leave the other axes without any error."""
    fitted = len(landscape.moved)
    if landscape.frames <= fitted:
        return None
    for wider in WIDER:
        gradients, information = _derivatives(landscape, wider * landscape.cells.step_rad)
        try:
            inverse = inverted(information)
        except ValueError:
            continue
        scattered = scatter(gradients, fitted)
        if not _is_of_full_rank(scattered):
            return None
        return Noise(congruent(inverse, scattered), information, effective_frame_count(gradients, inverse))
    return None


def _derivatives(landscape: Landscape, step_rad: float) -> tuple[NDArray[np.float64], list[list[float]]]:
    """The gradient (n, F, B) of each cell, and the negative Hessian (n, n) of their sum."""
    shape, count = landscape.centre.shape, len(landscape.moved)
    steps = of_both(step_rad)[list(landscape.moved)]

    def at(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        return landscape.at(offsets).reshape(len(offsets), -1)

    gradients, second = along(at, steps, range(count))
    information = [[0.0] * count for _ in range(count)]
    for i in range(count):
        information[i][i] = -fsum(second[i].tolist())
    pairs = list(combinations(range(count), 2))
    for (i, j), mixed in zip(pairs, across(at, steps, pairs), strict=True):
        information[i][j] = information[j][i] = -fsum(mixed.tolist())
    return gradients.reshape(count, *shape), information


def _is_of_full_rank(covariance: Rows) -> bool:
    """Whether every combination of the figures scatters."""
    deviations = [sqrt(row[i]) for i, row in enumerate(covariance)]
    if min(deviations) == 0.0:
        return False
    of_all = range(len(covariance))
    values = eigen([[covariance[i][j] / deviations[i] / deviations[j] for j in of_all] for i in of_all])
    return values[-1][0] > SAME * values[0][0]


def effective_frame_count(gradients: NDArray[np.float64], inverse: list[list[float]]) -> float:
    """The number of independent looks of F frames, from the gradients (n, F, B) of their cells and the inverse (n, n)
    of the information. It is F over the design effect (Kish 1965): how much more the sectors scatter than they would if
    the cells of each frame were independent of those of the others."""
    n, frames, _ = gradients.shape

    def size(groups: NDArray[np.float64]) -> float:
        rows = groups.reshape(n, -1).tolist()
        squares = [[fsum(a * b for a, b in zip(one, other, strict=True)) for other in rows] for one in rows]
        return fsum(inverse[i][j] * squares[j][i] for i in range(n) for j in range(n))

    together = size(gradients.sum(axis=1))
    return min(max(frames * size(gradients) / together, 1.0), float(frames)) if together > 0.0 else float(frames)


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


def measure_uncertainty(
    objective: Divisible,
    pose: Matrix4,
    moved: Sequence[int],
    rivals: Sequence[Rivals],
    relaxed: Sequence[RelaxedAssumption],
    window: Window,
    held_m: float,
) -> Uncertainty:
    """The uncertainty of the optimum at `pose` (4, 4), searched along the axes `moved` of ξ; unknown if the objective
    has no maximum there or the frames are too few.

    `rivals` are other summits that the search found. `loosened` is how the pose moves when assumptions are set free. A
    held translation is known to `held_m`.
    """
    axes = tuple(moved)
    landscape = Landscape.about(objective.cells(pose), pose, axes)
    noise = measure_noise(landscape)
    if noise is None:
        return Uncertainty.unknown()
    covariance = widened(landscape, noise)
    for summits in rivals:
        covariance = with_modes(summits, axes, covariance)
    whole = np.full((6, 6), np.nan)
    whole[np.ix_(axes, axes)] = covariance
    axis_of_sweep = pose[:3, 2]  # the third axis of the LiDAR
    shared = systematic_shifts(landscape.cells.points, sensor_resolution(window, pose, held_m), axes, axis_of_sweep)
    for one in relaxed:
        shared[one.name] = one.believed * np.where(np.isin(np.arange(6), axes), one.shift, 0.0)
    return Uncertainty(whole, shared, noise.independent_samples)
