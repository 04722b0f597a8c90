"""Solves a pose again with its assumptions set free: does the window contradict what it was told?

A held camera centre, trusted clocks and a lens taken from a sheet, if wrong, leave a pattern in the residuals that no
pose removes. They are set free one after the other, the earlier ones staying free: the centre, then the clocks, then
the lens (a nested likelihood ratio, Wilks 1938, on the sharpest edges). The gain is compared with the scatter of frames
and sectors of the image. How far the pose moves meanwhile is how far the assumption led it astray, as far as the window
is believed (`belief`). Where climbs have several ends, the one is taken that led it farthest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.belief import centre_weight, posterior_weight
from coec.calibration.confidence.landscape import certainty
from coec.calibration.confidence.told import (
    CLOCKS,
    LATE,
    LENS,
    PRINCIPAL_POINT,
    REACH,
    SHIFTS,
    SIZE,
    AssumedEdges,
    assumed_levels,
    moves,
)
from coec.calibration.confidence.ways import ParameterSubset, ends_along, local_ascent
from coec.calibration.objective.cells import COLUMNS, ROWS, sectors
from coec.calibration.types import Matrix4, Window
from coec.geometry import se3
from coec.geometry.edges.alignment import LEAST_SQUARE, EdgeFrames, alignment_of_parts

HELD_FREE, CLOCKS_FREE, LENS_FREE = "held_free", "clocks_free", "lens_free"
"""Names of the assumptions that are set free."""

EVEN = 1.0
"""Certainty (`landscape.certainty`) at which clocks are as likely wrong as right: two standard deviations on a
paraboloid. Chance reaches it once in ten windows, and then moves the pose by a few hundredths of a degree or a few
centimetres. An offset of the clocks that looks like a shift along the way gains little more, but moves the pose by
decimetres."""

LENS_EVEN = 1.5
"""Likewise for a lens: three standard deviations. Its principal point acts nearly like a turn of the pose, so that a
gain by chance moves the pose by half a degree."""

UNSEEN = COLUMNS * ROWS
"""Sector for everything outside the image."""

LEAST_PX = 0.4
"""A different lens matters only if it moves the sharpest edges by this much, root mean square, beyond what the pose can
do: corners of a target are found to a tenth of a pixel, and blur displaces edges by as much. In 48 windows of twelve
simulated drives through the assumed lens it was less, or not certain; in all 16 of four drives through another lens it
was more, and certain. It is also the error that edges by themselves leave in a lens: a lens that moves them by as much
is half believed (`beside_a_turn`)."""


@dataclass(frozen=True, slots=True, eq=False)
class RelaxedAssumption:
    """The result of setting one assumption free.

    Attributes:
        name: of the assumption.
        certainty: of the gain; see `Landscape.certainty`.
        moved_px: how far it moves the edges beyond what the pose can do, root mean square, pixels of the sharpest map.
        deviation: (12,) from what was assumed, together with what was set free before it; see `told`.
        shift: (6,) by how much the pose turned and shifted meanwhile, rad and m.
        believed: the share by which the shift counts.
    """

    name: str
    certainty: float
    moved_px: float
    deviation: NDArray[np.float64]
    shift: NDArray[np.float64]
    believed: float

    @property
    def astray(self) -> float:
        """The largest share of its reach by which an axis of the pose moves, as far as that is believed."""
        return self.believed * float(np.max(np.abs(self.shift) / REACH[: SHIFTS.stop]))

    @property
    def matters(self) -> bool:
        """Whether it moves the edges by more than the error that calibrations leave."""
        return self.moved_px >= LEAST_PX

    @property
    def contradicts(self) -> bool:
        """Whether the window is believed rather than the assumption."""
        return self.believed >= 0.5


def relax_assumptions(
    edges: Sequence[EdgeFrames], window: Window, pose: Matrix4, held: Sequence[int], known_m: float
) -> tuple[RelaxedAssumption, ...]:
    """Sets the assumptions of a window free, one after the other; empty if the edges in view do not determine a pose.

    Args:
        edges: of the window, from coarser levels that lead to the sharpest one.
        window: the window whose assumptions are set free.
        pose: (4, 4) where its search ended.
        held: the translations (places in ξ) that were taken as known.
        known_m: the standard deviation to which each of them is known.
    """
    levels = assumed_levels(edges, window, pose)
    free: list[tuple[str, Sequence[int], Sequence[int]]] = [(HELD_FREE, held, ())] if held else []
    if moves(window):
        free.append((CLOCKS_FREE, CLOCKS, LATE))
    free.append((LENS_FREE, LENS, PRINCIPAL_POINT))
    base = tuple(axis for axis in range(SHIFTS.stop) if axis not in held)
    try:
        before = local_ascent(levels[-1:], ParameterSubset.of(levels[-1], np.zeros(SIZE), base, ()), np.zeros(SIZE))
        results = []
        for name, places, along in free:
            subset = ParameterSubset.of(levels[-1], before, base, tuple(places))
            ends = ends_along(along, levels, subset, before)
            judged = [_judged(name, levels[-1], subset, before, after, known_m) for after in ends]
            results.append(max(judged, key=lambda one: one.astray))
            base, before = (*base, *places), results[-1].deviation
    except ValueError:
        return ()
    return tuple(results)


def _judged(
    name: str,
    sharp: AssumedEdges,
    subset: ParameterSubset,
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    known_m: float,
) -> RelaxedAssumption:
    uv_px, seen = sharp.pixels(after)
    sector = np.full(len(uv_px), UNSEEN, np.uint8)
    sector[seen] = sectors(uv_px[seen])
    shift = se3.difference(sharp.otherwise(after)[1], sharp.otherwise(before)[1])
    gained = certainty(_cells(sharp, after, sector) - _cells(sharp, before, sector))
    moved_px = subset.moved_px(after - before)
    if name == HELD_FREE:
        believed = centre_weight(gained, hypot(*(after - before)[list(subset.free)].tolist()), known_m)
    elif name == CLOCKS_FREE:
        believed = posterior_weight(gained, EVEN)
    else:
        believed = posterior_weight(gained, LENS_EVEN) * weight_beyond_turn(moved_px)
    return RelaxedAssumption(name, gained, moved_px, after, shift, believed)


def weight_beyond_turn(moved_px: float) -> float:
    """The share by which a lens is believed that moves the edges by so much beyond the pose that answers it.

    A lens trades its principal point against a turn of the camera: one that moves the edges by a fifth of a pixel
    beyond the turn turns the camera by half a degree. `moved_px` is measured with an error of `LEAST_PX`, so only the
    part of it that is not error is believed (Wiener 1949).
    """
    return moved_px**2 / (moved_px**2 + LEAST_PX**2)


def _cells(sharp: AssumedEdges, deviation: NDArray[np.float64], sector: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(F, B) what each frame adds to the significance in each sector; `sector` (E,) is where each range edge lies."""
    frames, pose = sharp.otherwise(deviation)
    of_parts = alignment_of_parts(frames, sector, UNSEEN + 1, pose[None])
    square = float(of_parts.square[0, :, :UNSEEN].sum())
    return np.asarray(of_parts.strength[0, :, :UNSEEN] / sqrt(max(square, LEAST_SQUARE)))
