"""Where a LiDAR looks during a sweep, and when: whole turns, a mirror's raster, the rosette of two prisms.

LiDAR axes: x forward, y left, z up. The stamp of a sweep is its middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

DoublesOfPatterns = NDArray[np.float64]

PRISM_HZ = (121.57, -77.73)
"""Turns of the two prisms, 7294 and -4664 a minute, as in the first Livox sensors. Their ratio is not one of small
whole numbers, so that no sweep repeats the last one."""
PRISM_RAD = 0.307
"""How far one prism bends the beam: 17.6°; both together fill a circle of 70.4°."""


class Fired(NamedTuple):
    """The rays of a sweep.

    Attributes:
        rays: (columns, beams, 3) unit.
        offset_s: (columns,) when each column is fired, relative to the stamp.
    """

    rays: DoublesOfPatterns
    offset_s: DoublesOfPatterns


class Pattern(Protocol):
    """The rays of a kind of sensor."""

    @property
    def beams(self) -> int:
        """How many beams are fired at once."""
        ...

    @property
    def ringed(self) -> bool:
        """Whether the cloud tells the beam of each point."""
        ...

    def fired(self, time_s: float, period_s: float) -> Fired:
        """The sweep whose middle is at a time."""
        ...


@dataclass(frozen=True, slots=True)
class Turn:
    """A head that turns clockwise from the rear, so that it looks forward in the middle of its turn. Beams are numbered
    from the lowest up."""

    elevations_rad: tuple[float, ...]
    columns: int

    ringed = True

    @property
    def beams(self) -> int:
        """See `Pattern`."""
        return len(self.elevations_rad)

    def fired(self, time_s: float, period_s: float) -> Fired:  # noqa: ARG002 - the same at any time
        """See `Pattern`."""
        return _columns(2 * np.pi, self.columns, self.elevations_rad, period_s)


@dataclass(frozen=True, slots=True)
class Raster:
    """A mirror that sweeps a fan of beams (numbered from the lowest up) from left to right, once per sweep."""

    width_rad: float
    elevations_rad: tuple[float, ...]
    columns: int

    ringed = False

    @property
    def beams(self) -> int:
        """See `Pattern`."""
        return len(self.elevations_rad)

    def fired(self, time_s: float, period_s: float) -> Fired:  # noqa: ARG002 - the same at any time
        """See `Pattern`."""
        return _columns(self.width_rad, self.columns, self.elevations_rad, period_s)


@dataclass(frozen=True, slots=True)
class Rosette:
    """Two prisms that turn in opposite directions bend a row of beams into loops that fill a circle over time.

    Attributes:
        columns: firings in a sweep.
        beams: number in the upright row.
        apart_rad: angle between neighbouring beams.
    """

    columns: int = 4000
    beams: int = 6
    spacing_rad: float = 0.005

    ringed = False

    def fired(self, time_s: float, period_s: float) -> Fired:
        """See `Pattern`."""
        offset_s = period_s * ((np.arange(self.columns) + 0.5) / self.columns - 0.5)
        first, second = (2 * np.pi * hertz * (time_s + offset_s) for hertz in PRISM_HZ)
        left = PRISM_RAD * (np.cos(first) + np.cos(second))
        up = PRISM_RAD * (np.sin(first) + np.sin(second))
        row = self.spacing_rad * (np.arange(self.beams) - (self.beams - 1) / 2)
        left, up = np.broadcast_arrays(left[:, None], up[:, None] + row)
        away = np.hypot(left, up)
        share = np.sinc(away / np.pi)  # sin(x)/x: from the angle to the unit vector
        return Fired(np.stack([np.cos(away), left * share, up * share], axis=-1), offset_s)


def even_deg(low_deg: float, high_deg: float, beams: int) -> tuple[float, ...]:
    """Evenly spaced elevations, given in degrees, returned in radians."""
    return tuple(float(angle) for angle in np.deg2rad(np.linspace(low_deg, high_deg, beams)))


def _columns(width_rad: float, columns: int, elevations_rad: tuple[float, ...], period_s: float) -> Fired:
    """A sweep of upright fans from left to right over a width."""
    azimuth = width_rad / 2 - width_rad * (np.arange(columns) + 0.5) / columns
    up = np.asarray(elevations_rad)
    rays = np.stack(
        [
            np.outer(np.cos(azimuth), np.cos(up)),
            np.outer(np.sin(azimuth), np.cos(up)),
            np.broadcast_to(np.sin(up), (columns, len(up))),
        ],
        axis=-1,
    )
    return Fired(rays, -period_s * azimuth / width_rad)
