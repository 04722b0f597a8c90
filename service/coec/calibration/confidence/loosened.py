"""A pose once more, with what was taken as known set free: does the window contradict what it was told?

A camera's centre that was held, clocks that were believed and a lens that was taken from a sheet all leave a pattern in
the residuals that no pose takes away. Each is set free in turn, after the ones before it: the centre, then the clocks,
then the lens (a nested likelihood ratio, Wilks 1938, on the sharpest edges). What is gained is counted against how
frames and sectors of the image scatter; what the pose moves by meanwhile is what it was led astray by, as far as the
window is believed (`belief`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.belief import in_centre, in_doubt
from coec.calibration.confidence.landscape import certainty
from coec.calibration.confidence.told import CLOCKS, LENS, SHIFTS, SIZE, Told, levels_told, moves
from coec.calibration.confidence.ways import Ways, climbed
from coec.calibration.objective.cells import COLUMNS, ROWS, sectors
from coec.calibration.types import Matrix4, Window
from coec.geometry import se3
from coec.geometry.edges.alignment import LEAST_SQUARE, EdgeFrames, alignment_of_parts

HELD_FREE, CLOCKS_FREE, LENS_FREE = "held_free", "clocks_free", "lens_free"
"""Names of what is set free."""

EVEN = 1.0
"""Certainty (`landscape.certainty`) at which clocks are as likely wrong as right: two standard deviations on a
paraboloid. Chance reaches it once in ten windows, and then moves the pose by a few hundredths of a degree or
centimetres. An offset of the clocks that looks like a shift along the way gains little more than that and moves the
pose by decimetres."""

LENS_EVEN = 1.5
"""Likewise of a lens: three standard deviations. Its centre is nearly a turn of the pose, so that what chance gains by
it moves the pose by half a degree."""

UNSEEN = COLUMNS * ROWS
"""Sector of what is outside the image."""

LEAST_PX = 0.4
"""Another lens has to move the sharpest edges by so much, root mean square, beside what the pose can do: corners of a
target are found to a tenth of a pixel, and edges are drawn aside by blur by as much. In 48 windows of twelve simulated
drives through the lens they were told it was less, or not certain; in all 16 of four through another it was both. It is
what edges leave to a lens by themselves: one that moves them by as much is half believed (`beside_a_turn`)."""


@dataclass(frozen=True, slots=True, eq=False)
class Loosened:
    """What setting something free came to.

    Attributes:
        name: of what was set free.
        certainty: of the gain; see `Landscape.certainty`.
        moved_px: what it moves the edges by beside what the pose can do, root mean square, pixels of the sharpest map.
        deviation: (12,) from what was told, with what was set free before it; see `told`.
        shift: (6,) by how much the pose turned and shifted meanwhile, rad and m.
        believed: by what share the shift counts.
    """

    name: str
    certainty: float
    moved_px: float
    deviation: NDArray[np.float64]
    shift: NDArray[np.float64]
    believed: float

    @property
    def matters(self) -> bool:
        """Whether it moves the edges by more than calibrations leave."""
        return self.moved_px >= LEAST_PX

    @property
    def contradicts(self) -> bool:
        """Whether the window is believed rather than what it was told."""
        return self.believed >= 0.5


def loosen(
    edges: Sequence[EdgeFrames], window: Window, pose: Matrix4, held: Sequence[int], known_m: float
) -> tuple[Loosened, ...]:
    """What was taken as known, set free, one after the other; empty where the edges in view do not determine a pose.

    Args:
        edges: of the window, from a level that leads there to the sharpest one.
        window: it was solved to `pose` (4, 4), at the end of its search.
        held: the translations (places in ξ) that were taken as known.
        known_m: to this standard deviation each.
    """
    levels = levels_told(edges, window, pose)
    free = [(HELD_FREE, tuple(held))] if held else []
    if moves(window):
        free.append((CLOCKS_FREE, tuple(CLOCKS)))
    free.append((LENS_FREE, tuple(LENS)))
    base = tuple(axis for axis in range(SHIFTS.stop) if axis not in held)
    try:
        before = climbed(levels[-1:], Ways.of(levels[-1], np.zeros(SIZE), base, ()), np.zeros(SIZE))
        found = []
        for name, places in free:
            ways = Ways.of(levels[-1], before, base, places)
            after = climbed(levels, ways, before)
            found.append(_judged(name, levels[-1], ways, before, after, known_m))
            base, before = (*base, *places), after
    except ValueError:
        return ()
    return tuple(found)


def _judged(
    name: str, sharp: Told, ways: Ways, before: NDArray[np.float64], after: NDArray[np.float64], known_m: float
) -> Loosened:
    uv_px, seen = sharp.pixels(after)
    sector = np.full(len(uv_px), UNSEEN, np.uint8)
    sector[seen] = sectors(uv_px[seen])
    shift = se3.difference(sharp.otherwise(after)[1], sharp.otherwise(before)[1])
    gained = certainty(_cells(sharp, after, sector) - _cells(sharp, before, sector))
    moved_px = ways.moved_px(after - before)
    if name == HELD_FREE:
        believed = in_centre(gained, hypot(*(after - before)[list(ways.free)].tolist()), known_m)
    elif name == CLOCKS_FREE:
        believed = in_doubt(gained, EVEN)
    else:
        believed = in_doubt(gained, LENS_EVEN) * beside_a_turn(moved_px)
    return Loosened(name, gained, moved_px, after, shift, believed)


def beside_a_turn(moved_px: float) -> float:
    """By what share a lens is believed that moves the edges by so much beside the pose that answers it. It trades its
    centre against a turn of the camera, so that what moves the edges by a fifth of a pixel beside the turn turns the
    camera by half a degree: of what was measured with an error of `LEAST_PX` the part that is not error is believed
    (Wiener 1949)."""
    return moved_px**2 / (moved_px**2 + LEAST_PX**2)


def _cells(sharp: Told, deviation: NDArray[np.float64], sector: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(F, B) what each frame adds to the significance in each sector; `sector` (E,) is where each range edge lies."""
    frames, pose = sharp.otherwise(deviation)
    of_parts = alignment_of_parts(frames, sector, UNSEEN + 1, pose[None])
    square = float(of_parts.square[0, :, :UNSEEN].sum())
    return np.asarray(of_parts.strength[0, :, :UNSEEN] / sqrt(max(square, LEAST_SQUARE)))
