"""The poor stretches of a road, as places: its tunnels, and where nothing stands beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from coec.simulation.faults import Fault, OpenRoad, Tunnel
from coec.simulation.vehicle import Pace

F = TypeVar("F", bound=Fault)

CLEAR_M = 120.0
"""Nothing stands within this distance of a vehicle on an open road: the longest reach in `lidar.LIDARS`."""
OBJECT_REACH_M = 3.0
"""An object reaches up to this far along the road from its middle: half a parked car, and a little more."""
LONGEST_BEYOND_S = 30.0
"""Passages reach at most this far beyond the end of the drive; the road goes on for longer."""


@dataclass(frozen=True, slots=True)
class RoadSpan:
    """A part of the road by arc length, metres; the end is not part of it."""

    begin_m: float
    end_m: float

    def holds(self, s_m: float) -> bool:
        """Whether a place lies in the span."""
        return self.begin_m <= s_m < self.end_m

    def part(self, begin_m: float, end_m: float) -> RoadSpan | None:
        """The part of the span between two places; None if there is none."""
        low, high = max(self.begin_m, begin_m), min(self.end_m, end_m)
        return RoadSpan(low, high) if low < high else None

    def widened(self, by_m: float) -> RoadSpan:
        """The span extended by so much at both ends."""
        return RoadSpan(self.begin_m - by_m, self.end_m + by_m)


@dataclass(frozen=True, slots=True)
class Passages:
    """The poor stretches of a road.

    Attributes:
        tunnels: from mouth to mouth.
        open: where the vehicle is while there is nothing but ground around it.
    """

    tunnels: tuple[RoadSpan, ...] = ()
    open: tuple[RoadSpan, ...] = ()

    def cleared(self) -> tuple[RoadSpan, ...]:
        """Where nothing stands or drives, so that the road is open."""
        return tuple(span.widened(CLEAR_M) for span in self.open)

    def empty(self) -> tuple[RoadSpan, ...]:
        """Where nothing stands."""
        return (*self.cleared(), *(span.widened(OBJECT_REACH_M) for span in self.tunnels))


def passages(faults: tuple[Fault, ...], pace: Pace, seconds: float) -> Passages:
    """Where the vehicle is while faults order a tunnel or an open road; `seconds` is the length of the drive."""

    def of(kind: type[F]) -> tuple[RoadSpan, ...]:
        of_kind = [fault for fault in faults if isinstance(fault, kind)]
        times = [(fault.begin_s, min(fault.end_s, seconds + LONGEST_BEYOND_S)) for fault in of_kind]
        spans = [pace.progress(np.array(both)) for both in times if both[0] < both[1]]
        return tuple(RoadSpan(float(low), float(high)) for low, high in spans if math.isfinite(high))

    return Passages(tunnels=of(Tunnel), open=of(OpenRoad))
