"""Reflectance edges: where the reflectance of a surface jumps along a scan line, though its range does not. Paint,
signs, plates, boards and joints of walls make such edges, and an image edge with each (METHOD, section 5).

Five neighbours along a scan line form a step if they lie on one smooth surface: two before, the point, two after. Its
height is the difference of the means of both sides. It counts as an edge if it is steep against the noise of this LiDAR
at this level and against the steps beside it, if both sides are plateaus, and if no step next to it is higher. Its
position between the neighbours follows from the value of the point in the middle, which the beam gathers from both
sides.

Every LiDAR has its own scale, quantisation and noise: calibrated values of 8 bits, or raw ones whose scatter grows with
their level. So the noise is learned from the sweeps: the median height of all steps at a level, most of which lie on
surfaces without an edge. An edge is compared with the noise at the levels of its two sides; between them there may be
edges only.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.edges.scan_lines import (
    MAX_NEIGHBOURS_TRIED,
    NEIGHBOUR_RAD,
    ScanLines,
    SweepEdges,
    turned_about_the_axis,
)
from coec.geometry.points import thinned

SMOOTH_M, SMOOTH_SHARE = 0.05, 0.02
"""Largest spread of the ranges of five neighbours on one surface: in metres, plus a share of the range."""

LEAST_STEP = 5.0
"""Least height of an edge, in standard deviations of steps without an edge."""

SURROUNDING = 24
"""Neighbours on a side whose steps show how rough the surface is there: an edge has to stand out from the smoother of
its sides by `LEAST_STEP` standard deviations, too. Within leaves and grass, which are rough on both, most steps lie
where an image shows none. See docs/measured.md."""

PLATEAU_SHARE = 0.5
"""Largest difference between the two points of a side, as a share of the height."""

SURFACE_SHARE = 0.03
"""Standard deviation of the reflectance of one surface, as a share of it: weaker steps are its texture, not an edge
that an image would show."""

LEVELS = 24
"""Levels of reflectance for which the noise is learned, each with as many steps as the others."""

LEAST_STEPS = 50
"""Least steps of a level."""

LEARNED_STEPS = 100_000
"""Most steps from which the noise is learned: each of `LEVELS` medians is then known to two per cent."""

QUANTISED_VALUES = 16_384
"""Most values of a sweep in which its quantisation is sought."""

MEDIAN_TO_SIGMA = 1.4826
"""Standard deviation of a normal variable with the median magnitude 1."""

MOST_VALUES = 4_096
"""A LiDAR with more different values is not quantised."""

QUANTISATION = math.sqrt(1.0 / 12.0)
"""Standard deviation of a difference of two means of two values that are rounded to whole steps."""


@dataclass(frozen=True, slots=True, eq=False)
class ReflectanceSteps:
    """Steps of reflectance at the points of a sweep, in the order of its scan lines.

    Attributes:
        lines: of the sweep.
        height: (M,) float32; NaN where five neighbours lie on no smooth surface.
        level: (M,) float32, the mean of both sides.
        turn_rad: (M,) float32, from the point to the edge, azimuth.
        roughness: (M,) float32, the median magnitude of the steps beside the highest ones, on their smoother side; 0
            elsewhere.
        highest: (M,) bool, whether both sides are plateaus and no step next to this one is higher.
        quantum: the distance between neighbouring values of the sweep; 0 if it is not quantised.
    """

    lines: ScanLines
    height: NDArray[np.float32]
    level: NDArray[np.float32]
    turn_rad: NDArray[np.float32]
    roughness: NDArray[np.float32]
    highest: NDArray[np.bool_]
    quantum: float


@dataclass(frozen=True, slots=True, eq=False)
class ReflectanceNoise:
    """Standard deviations `sigma` (B,) of steps without an edge at ascending levels `level` (B,) of reflectance."""

    level: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def at(self, level: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M,) at other levels (M,)."""
        return np.asarray(np.interp(level, self.level, self.sigma))


def reflectance_steps(lines: ScanLines, reflectance: NDArray[np.float32]) -> ReflectanceSteps:
    """The steps of reflectance along the scan lines of a sweep; `reflectance` (N,) is in any unit, and anything that is
    not finite is unknown."""
    values = np.where(np.isfinite(reflectance), reflectance, np.nan).astype(np.float32)
    height, level, turn_rad, roughness, highest = _steps(
        lines.first,
        lines.azimuth,
        lines.elevation,
        lines.range_m,
        values[lines.order],
        lines.same_line_rad,
        lines.one_line_per_row,
    )
    distinct = np.unique(values[thinned(len(values), QUANTISED_VALUES)])
    distinct = distinct[np.isfinite(distinct)]
    quantum = float(np.diff(distinct).min()) if 1 < len(distinct) <= MOST_VALUES else 0.0
    return ReflectanceSteps(lines, height, level, turn_rad, roughness, highest, quantum)


def learn_noise(sweeps: Sequence[ReflectanceSteps]) -> ReflectanceNoise | None:
    """The noise of a LiDAR, from its sweeps; None if there are too few steps, or all of one value."""
    if not sweeps:
        return None
    most = LEARNED_STEPS // len(sweeps)
    finite = [np.flatnonzero(np.isfinite(steps.height)) for steps in sweeps]
    finite = [of[thinned(len(of), most)] for of in finite]
    height = np.concatenate([np.abs(steps.height[of]) for steps, of in zip(sweeps, finite, strict=True)])
    level = np.concatenate([steps.level[of] for steps, of in zip(sweeps, finite, strict=True)])
    if len(height) < LEAST_STEPS or not height.any():
        return None
    ascending = np.argsort(level, kind="stable")
    parts = np.array_split(ascending, min(LEVELS, len(ascending) // LEAST_STEPS))
    levels = np.array([np.median(level[part]) for part in parts])
    sigma = MEDIAN_TO_SIGMA * np.array([np.median(height[part]) for part in parts], np.float64)
    quantum = min(steps.quantum for steps in sweeps)
    # Levels of one value, as zero often is, form several parts.
    distinct, first = np.unique(levels, return_index=True)
    texture = SURFACE_SHARE * np.maximum(np.abs(distinct), 1e-3 * np.ptp(levels))
    return ReflectanceNoise(distinct, np.hypot(np.hypot(sigma[first], QUANTISATION * quantum), texture))


def reflectance_edges(steps: ReflectanceSteps, noise: ReflectanceNoise) -> SweepEdges:
    """The edges among the steps of a sweep; all have weight 1."""
    at = np.flatnonzero(steps.highest)
    height, level = steps.height[at].astype(np.float64), steps.level[at].astype(np.float64)
    sides = [noise.at(level + share * height) for share in (-0.5, 0.5)]
    sigma = np.maximum(
        np.sqrt(0.5 * (sides[0] ** 2 + sides[1] ** 2)), MEDIAN_TO_SIGMA * steps.roughness[at].astype(np.float64)
    )
    at = at[np.abs(height) > LEAST_STEP * sigma]
    index = steps.lines.order[at].astype(np.int64)
    shift_m = turned_about_the_axis(steps.lines.xyz_m[index], steps.turn_rad[at])
    return SweepEdges(index, shift_m, np.ones(len(index), np.float32))


@njit(cache=True, parallel=PRANGE)
def _steps(
    first: NDArray[np.int64],
    azimuth: NDArray[np.float32],
    elevation: NDArray[np.float32],
    range_m: NDArray[np.float32],
    value: NDArray[np.float32],
    same_line: float,
    one_line_per_row: bool,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    count = azimuth.shape[0]
    height, level = np.full(count, np.nan, np.float32), np.zeros(count, np.float32)
    turn_rad, highest = np.zeros(count, np.float32), np.zeros(count, np.bool_)
    roughness = np.zeros(count, np.float32)
    following, previous = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
    for r in prange(first.shape[0] - 1):
        begin, end = first[r], first[r + 1]
        for k in range(begin, end):
            for ahead in range(1, MAX_NEIGHBOURS_TRIED + 1):
                j = k + ahead
                if j >= end or azimuth[j] - azimuth[k] > NEIGHBOUR_RAD:
                    break
                if one_line_per_row or abs(elevation[j] - elevation[k]) < same_line:
                    following[k] = j
                    if previous[j] < 0:
                        previous[j] = k
                    break
        for k in range(begin, end):
            b, c = previous[k], following[k]
            if b < 0 or c < 0:
                continue
            a, d = previous[b], following[c]
            if a < 0 or d < 0:
                continue
            near = min(min(min(range_m[a], range_m[b]), min(range_m[c], range_m[d])), range_m[k])
            far = max(max(max(range_m[a], range_m[b]), max(range_m[c], range_m[d])), range_m[k])
            if far - near > SMOOTH_M + SMOOTH_SHARE * near:
                continue
            before, after = np.float32(0.5) * (value[a] + value[b]), np.float32(0.5) * (value[c] + value[d])
            step = after - before
            height[k], level[k] = step, np.float32(0.5) * (before + after)
            if step == 0.0 or max(abs(value[b] - value[a]), abs(value[d] - value[c])) > PLATEAU_SHARE * abs(step):
                continue
            # The share of the beam that fell behind the edge moves it from the far side of the point to the near one.
            share = min(max((value[k] - before) / step, np.float32(0.0)), np.float32(1.0))
            turn_rad[k] = (np.float32(0.5) - share) * np.float32(0.5) * (azimuth[c] - azimuth[b])
            highest[k] = True
        for k in range(begin, end):
            if highest[k]:
                b, c = previous[k], following[k]
                # Of equally high neighbours the first one counts. A comparison with NaN is false.
                most = abs(height[k])
                highest[k] = not (
                    abs(height[previous[b]]) >= most
                    or abs(height[b]) >= most
                    or abs(height[c]) > most
                    or abs(height[following[c]]) > most
                )
                if highest[k]:
                    roughness[k] = min(_median_along(height, previous, k), _median_along(height, following, k))
    return height, level, turn_rad, roughness, highest


@njit(cache=True)
def _median_along(height: NDArray[np.float32], towards: NDArray[np.int32], k: int) -> float:
    """The median magnitude of the steps of the next `SURROUNDING` neighbours of point k; 0 if none is known."""
    along, number = np.empty(SURROUNDING, np.float32), 0
    for _ in range(SURROUNDING):
        k = towards[k]
        if k < 0:
            break
        if not math.isnan(height[k]):
            along[number] = abs(height[k])
            number += 1
    return float(np.median(along[:number])) if number else 0.0
