"""Clouds of several LiDARs in one: told by their rings, where no field tells the source of a point.

Who joins clouds appends one to the other (`pcl::concatenatePointCloud`, Autoware's `concatenate_data`): each LiDAR's
points are a block of the message. A block lies on cones of its own, and looks all around again from another place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.cones import Rings, elevation_rad

Doubles = NDArray[np.float64]

APART_M = 0.3
"""Origins nearer to each other than that are one: a sensor's height."""

THIN_RAD = math.radians(0.25)
"""Spread of the elevations within a ring that one LiDAR leaves: a beam, and a metre of driving during the sweep."""

BELONGS_RAD = 2 * THIN_RAD
"""A point farther than that from the beam of its ring is another's."""

BEGINNINGS = (1.0, 0.5, 0.25, 0.125)
"""Shares of the points, from the first on, that are tried as one LiDAR's."""

BLOCK = 0.1
"""Share of the points that the next LiDAR has at least; fewer may be anything."""

WITHIN, BEYOND = 0.6, 0.6
"""Share of the points that fit the first LiDAR's beams in its block at least, and behind it at most: a passer-by stands
beside the beams, and some of another's points lie on them by chance."""

SECTORS, COMMON = 36, 0.5
"""Of 10° around a LiDAR; and the share of those into which one LiDAR looks that the other sees too, at least. One that
drives on while it turns looks into each direction once."""


@dataclass(frozen=True, slots=True, eq=False)
class SeveralOrigins:
    """Two places from which blocks of a cloud's points were measured; a third may be there.

    Attributes:
        cones: of each (see `cones`), in the frame of the points.
        cause, setting: as of `ApparentOrigin`.
    """

    cones: tuple[Doubles, Doubles]

    cause: ClassVar[str] = "cloud_concatenated"
    setting: ClassVar[str] = "source"

    @property
    def origins_m(self) -> tuple[tuple[float, ...], ...]:
        """(3,) each."""
        return tuple(tuple(cones[:3].tolist()) for cones in self.cones)

    @property
    def sentence(self) -> str:
        """For people."""
        places = " and ".join("(" + ", ".join(f"{value:+.2f}" for value in origin) + ")" for origin in self.origins_m)
        return f"The cloud is concatenated: its points look measured from {places} m of their frame."


def several_origins(rings: Rings, before: SeveralOrigins | None = None) -> SeveralOrigins | None:
    """Two LiDARs, the points of one behind those of the other; None where the points are not seen to be of several.
    `before` is what explained the sweep before."""
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
    if second is None or math.dist(cones[:3], second[1][:3]) < APART_M:
        return None
    around = [_sectors(rings.xyz_m[:end], cones), _sectors(rings.xyz_m[end:], second[1])]
    if (around[0] & around[1]).sum() < COMMON * min(sectors.sum() for sectors in around):
        return None
    return SeveralOrigins((cones, second[1]))


def _beginning(rings: Rings, guesses: tuple[Doubles, ...]) -> tuple[Rings, Doubles] | None:
    """The longest beginning of the points that lies on cones, and these; None where none does."""
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


def _fits(rings: Rings, block: Rings, cones: Doubles) -> NDArray[np.bool_]:
    """(N,) whether a point lies on the beam that its ring has in the block; rings that are not in it have none."""
    beams_rad = np.full(int(rings.names.max()) + 1, np.nan)
    beams_rad[block.names] = block.beams_rad(cones)
    beside_rad = elevation_rad(rings.xyz_m, cones) - beams_rad[rings.names[rings.number]]
    return np.asarray(np.abs(beside_rad) <= BELONGS_RAD)


def _ends(fits: NDArray[np.bool_], end: int) -> bool:
    """Whether a LiDAR's points end there."""
    return bool(fits[:end].mean() >= WITHIN and fits[end:].mean() <= BEYOND)


def _sectors(xyz_m: Doubles, cones: Doubles) -> NDArray[np.bool_]:
    """(SECTORS,) whether there are points, seen from the tip of the cones."""
    ray_m = xyz_m - cones[:3]
    sector = ((np.arctan2(ray_m[:, 1], ray_m[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    return np.bincount(sector, minlength=SECTORS) > 0
