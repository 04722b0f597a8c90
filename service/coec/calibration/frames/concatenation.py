"""Recognises clouds of several LiDARs joined into one, by their rings, if no field names the source of a point.

Programs that join clouds append one to the other (`pcl::concatenatePointCloud`, Autoware's `concatenate_data`), so each
LiDAR's points are a block of the message. Each block lies on cones of its own, and looks all around from its own place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.cones import Rings, elevation_rad

DoublesOfConcatenation = NDArray[np.float64]

MIN_SEPARATION_M = 0.3
"""Origins nearer to each other than this count as one: the height of a sensor."""

THIN_RAD = math.radians(0.25)
"""Most spread of the elevations within a ring of one LiDAR: a beam, and a metre of driving during the sweep."""

BELONGS_RAD = 2 * THIN_RAD
"""A point farther than this from the beam of its ring belongs to another LiDAR."""

BEGINNINGS = (1.0, 0.5, 0.25, 0.125)
"""Shares of the points, from the first on, that are tried as the points of one LiDAR."""

BLOCK = 0.1
"""Least share of the points that a further LiDAR must have; fewer may be anything."""

WITHIN, BEYOND = 0.6, 0.6
"""Least share of the points in the first LiDAR's block that fit its beams, and most of the points behind the block that
do. Neither is all or none: a passer-by does not fit the beams, and some points of another LiDAR fit by chance."""

SECTORS, COMMON = 36, 0.5
"""Number of sectors around a LiDAR, 10° each; and the least share of the sectors of one LiDAR that the other must see,
too. That rules out a single LiDAR that drives on while it turns, because it looks into each direction once."""


@dataclass(frozen=True, slots=True, eq=False)
class SeveralOrigins:
    """Two places from which blocks of a cloud's points were measured; a third may be there.

    Attributes:
        cones: those of each LiDAR (see `cones`), in the frame of the points.
        cause, setting: as in `ApparentOrigin`.
    """

    cones: tuple[DoublesOfConcatenation, DoublesOfConcatenation]

    cause: ClassVar[str] = "cloud_concatenated"
    setting: ClassVar[str] = "source"

    @property
    def origins_m(self) -> tuple[tuple[float, ...], ...]:
        """The place (3,) of each LiDAR."""
        return tuple(tuple(cones[:3].tolist()) for cones in self.cones)

    @property
    def sentence(self) -> str:
        """For people."""
        places = " and ".join("(" + ", ".join(f"{value:+.2f}" for value in origin) + ")" for origin in self.origins_m)
        return f"The cloud is concatenated: its points look as if measured from {places} m in their frame."


def several_origins(rings: Rings, before: SeveralOrigins | None = None) -> SeveralOrigins | None:
    """Two LiDARs, if the points of one follow those of the other; None if several LiDARs cannot be recognised. `before`
    is what explained the last sweep."""
    guesses = (np.zeros(5), *(before.cones if before else ()))
    first = _beginning(rings, guesses)
    if first is None:
        return None
    block, cones = first
    fits = _fits(rings, block, cones)
    end = int(np.argmax(np.cumsum(np.where(fits, 1, -1)))) + 1
    rest = rings.part(end, len(fits))
    if rest is None or len(fits) - end < BLOCK * len(fits) or not _ends(fits, end):
        return None
    second = _beginning(rest, guesses)
    if second is None or math.dist(cones[:3], second[1][:3]) < MIN_SEPARATION_M:
        return None
    around = [_sectors(rings.xyz_m[:end], cones), _sectors(rings.xyz_m[end:], second[1])]
    if (around[0] & around[1]).sum() < COMMON * min(sectors.sum() for sectors in around):
        return None
    return SeveralOrigins((cones, second[1]))


def _beginning(
    rings: Rings, guesses: tuple[DoublesOfConcatenation, ...]
) -> tuple[Rings, DoublesOfConcatenation] | None:
    """The longest block at the beginning of the points that lies on cones, and those cones; None if none does."""
    for share in BEGINNINGS:
        block = rings.part(0, int(share * len(rings.xyz_m)))
        if block is None:
            return None
        cones = next((guess for guess in guesses if block.spread_rad(guess) <= THIN_RAD), None)
        if cones is None:
            cones = block.sharpest()
        if block.spread_rad(cones) <= THIN_RAD:
            return block, cones
    return None


def _fits(rings: Rings, block: Rings, cones: DoublesOfConcatenation) -> NDArray[np.bool_]:
    """(N,) whether each point lies on the beam of its ring in the block; rings that are not in the block have no
    beam."""
    beams_rad = np.full(int(rings.names.max()) + 1, np.nan)
    beams_rad[block.names] = block.beams_rad(cones)
    deviation_rad = elevation_rad(rings.xyz_m, cones) - beams_rad[rings.names[rings.number]]
    return np.asarray(np.abs(deviation_rad) <= BELONGS_RAD)


def _ends(fits: NDArray[np.bool_], end: int) -> bool:
    """Whether the points of the first LiDAR end there."""
    return bool(fits[:end].mean() >= WITHIN and fits[end:].mean() <= BEYOND)


def _sectors(xyz_m: DoublesOfConcatenation, cones: DoublesOfConcatenation) -> NDArray[np.bool_]:
    """(SECTORS,) whether each sector holds points, seen from the tip of the cones."""
    ray_m = xyz_m - cones[:3]
    sector = ((np.arctan2(ray_m[:, 1], ray_m[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    return np.bincount(sector, minlength=SECTORS) > 0
