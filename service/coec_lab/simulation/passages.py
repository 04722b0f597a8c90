"""Stretches of the road with little to see: tunnels, rooms that keep the sky off, and parts where nothing stands next
to the road; and the ground along a stretch on which objects are placed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coec_lab.simulation.faults import Fault, OpenRoad, Tunnel
from coec_lab.simulation.mesh import Floats, Material, Mesh, quads
from coec_lab.simulation.road import Road
from coec_lab.simulation.vehicle_motion import Pace

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


Doubles = NDArray[np.float64]

LAMP_HEAD_M = 0.15
"""Height of the head of a street lamp."""


class Site:
    """Gathers the meshes of a stretch at places along the road. `left_m` counts from the centre line.

    Attributes:
        origin_m: (3,) world position that is the origin of the meshes.
        meshes: what was put there so far.
        lamps_m: (3,) each, street lamps that were put there, relative to `origin_m`.
    """

    def __init__(self, road: Road, begin_m: float, empty: tuple[RoadSpan, ...] = ()) -> None:
        """`empty`: spans of the road on which nothing is put."""
        self.road = road
        self.begin_m = begin_m
        self.origin_m = road.points(begin_m, 0.0, 0.0)
        self.meshes: list[Mesh] = []
        self.lamps_m: list[Doubles] = []
        self._empty = empty

    def put(self, mesh: Mesh, s_m: float, left_m: float, turn_rad: float = 0.0, up_m: float = 0.0) -> None:
        """Puts a mesh at arc length `begin_m + s_m`, its x along the road before it is turned. Does nothing where the
        site has to stay empty."""
        if any(span.holds(self.begin_m + s_m) for span in self._empty):
            return
        x, y, z = self.road.points(self.begin_m + s_m, left_m, up_m) - self.origin_m
        heading = float(self.road.at(self.begin_m + s_m)[3])
        self.meshes.append(mesh.placed(float(x), float(y), float(z), heading + turn_rad))

    def put_lamp(self, mesh: Mesh, s_m: float, left_m: float, turn_rad: float, up_m: float) -> None:
        """Puts a street lamp, whose head is its highest part, as `put` does."""
        before = len(self.meshes)
        self.put(mesh, s_m, left_m, turn_rad, up_m)
        for placed in self.meshes[before:]:
            corners = placed.corners_m.reshape(-1, 3).astype(np.float64)
            top = corners[:, 2].max()
            head = corners[corners[:, 2] > top - LAMP_HEAD_M].mean(axis=0)
            self.lamps_m.append(np.array([head[0], head[1], top - LAMP_HEAD_M]))

    def strip(self, s_m: Doubles, left_m: tuple[float, float], up_m: tuple[float, float]) -> Floats:
        """(Q, 4, 3) quads that follow the road between the given arc lengths, counted from `begin_m`."""
        a = self.road.points(self.begin_m + s_m, left_m[0], up_m[0]) - self.origin_m
        b = self.road.points(self.begin_m + s_m, left_m[1], up_m[1]) - self.origin_m
        return np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1).astype(np.float32)


HIGH_M = 4.8
"""Height of the ceiling above the road: room for a lorry of 4.0 m and for signs."""
VERGE_M = 0.8
"""Distance from the edge of the lane to the wall."""
STRIP_HALF_M, STRIP_DOWN_M = 0.15, 0.05
"""Half the width of the strip of lamps, and how far it hangs below the ceiling."""
STEP_M = 3.0
"""Length of the straight pieces of walls: at most 1.3 cm off the curve at the tightest bend."""
COVER_M, HILL_FLAT_M, HILL_FOOT_M = 1.6, 9.0, 42.0
"""The hill: height above the ceiling, half the width of its top, and how far from the middle it meets the ground."""
WALL, CEILING = (0.42, 0.45, 0.46), (0.20, 0.20, 0.20)
PORTAL, TURF = (0.30, 0.31, 0.31), (0.09, 0.22, 0.16)
SPINE_M = 1.0
"""Spacing of a spine."""
CLAD_M, CLAD_COLOURS = 3.0, ((0.60, 0.62, 0.62), (0.52, 0.54, 0.55))
"""Height of the panels on the walls, and their colours."""
PANEL_M, JOINT_M = 4.0, 0.05
"""Length of a panel, and the width of the joint between two."""
WALKWAY_M, WALKWAY_HIGH_M = 0.5, 0.2
EXITS_M = 24.0
"""Spacing of the signs that show the way out, and of niches with doors, by turns on either side."""


@dataclass(frozen=True, slots=True, eq=False)
class Bore:
    """The room inside a tunnel, or anything else with a ceiling and a strip of lamps over the middle of the road.

    Attributes:
        spine: (K, 5) points of the road's middle at every `SPINE_M` from one mouth to the other: x, y, z in metres
            (world), cosine and sine of the heading.
        half_m: distance from the middle to a wall.
        high_m: height of the ceiling above the road.
        light: of its lamps, relative to those of a tunnel.
    """

    spine: Doubles
    half_m: float
    high_m: float = HIGH_M
    light: float = 1.0


def bore(road: Road, span: RoadSpan, lane_m: float) -> Bore:
    """The room of the tunnel of a span, on a road with lanes of this width."""
    return bore_of(road, span.begin_m, span.end_m, lane_m + VERGE_M, HIGH_M, 1.0)


def bore_of(road: Road, begin_m: float, end_m: float, half_m: float, high_m: float, light: float) -> Bore:
    """A room along the road between two places."""
    s = np.linspace(begin_m, end_m, max(round((end_m - begin_m) / SPINE_M), 1) + 1)
    x, y, z, heading, _ = np.moveaxis(road.at(s), -1, 0)
    return Bore(np.column_stack([x, y, z, np.cos(heading), np.sin(heading)]), half_m, high_m, light)


def dig(site: Site, span: RoadSpan, part: RoadSpan, lane_m: float) -> None:
    """Adds the part of a tunnel that lies on a site, with the face of the hill at its mouths."""
    half = lane_m + VERGE_M
    first, last = part.begin_m - site.begin_m, part.end_m - site.begin_m
    s = np.linspace(first, last, int(np.ceil((last - first) / STEP_M)) + 1)
    top = HIGH_M + COVER_M
    lamps = HIGH_M - STRIP_DOWN_M
    site.meshes += [
        quads(site.strip(s, (-half, half), (HIGH_M, HIGH_M)), CEILING, Material.PAINT),
        quads(site.strip(s, (-STRIP_HALF_M, STRIP_HALF_M), (lamps, lamps)), (1.0, 1.0, 1.0), Material.LAMP),
        quads(site.strip(s, (-HILL_FLAT_M, HILL_FLAT_M), (top, top)), TURF, Material.GRASS),
    ]
    for side in (-1.0, 1.0):
        wall = site.strip(s, (side * half, side * half), (-0.3, HIGH_M))
        slope = site.strip(s, (side * HILL_FLAT_M, side * HILL_FOOT_M), (top, -0.3))
        site.meshes += [quads(wall, WALL, Material.PAINT), quads(slope, TURF, Material.GRASS)]
        _line(site, part, side, half)
    for mouth_m in (span.begin_m, span.end_m):
        if mouth_m in (part.begin_m, part.end_m):
            _face(site, mouth_m, half, top)


def _line(site: Site, part: RoadSpan, side: float, half_m: float) -> None:
    """Panels with joints, a walkway, a cable tray, doors and signs along one wall of a part of a tunnel."""

    def sheet(begin_m: float, end_m: float, in_m: float, low_m: float, high_m: float) -> Floats:
        """(1, 4, 3) on the wall, so far in front of it, between two places along the road."""
        left = side * (half_m - in_m)
        return site.strip(np.array([begin_m, end_m]) - site.begin_m, (left, left), (low_m, high_m))

    first, last = (math.ceil(part.begin_m / PANEL_M), math.floor(part.end_m / PANEL_M))
    for number in range(first, last):
        begin, end = number * PANEL_M, (number + 1) * PANEL_M
        colour = CLAD_COLOURS[number % 7 == 3]
        site.meshes += [
            quads(sheet(begin, end, 0.02, WALKWAY_HIGH_M, CLAD_M), colour, Material.PAINT),
            quads(sheet(begin, begin + JOINT_M, 0.025, WALKWAY_HIGH_M, CLAD_M), (0.08, 0.08, 0.08), Material.RUBBER),
            quads(sheet(begin, end, 0.03, CLAD_M, CLAD_M + 0.08), (0.10, 0.12, 0.14), Material.PAINT),
            quads(sheet(begin, end, 0.25, HIGH_M - 0.5, HIGH_M - 0.4), (0.45, 0.46, 0.46), Material.STEEL),
            quads(sheet(begin, end, WALKWAY_M, -0.1, WALKWAY_HIGH_M), (0.4, 0.41, 0.41), Material.CONCRETE),
        ]
        top = site.strip(
            np.array([begin, end]) - site.begin_m, (side * half_m, side * (half_m - WALKWAY_M)), (WALKWAY_HIGH_M,) * 2
        )
        site.meshes.append(quads(top, (0.4, 0.41, 0.41), Material.CONCRETE))
        if number * PANEL_M % EXITS_M == (0.0 if side > 0 else EXITS_M / 2):
            middle = begin + PANEL_M / 2
            green = quads(sheet(middle - 0.45, middle + 0.45, 0.05, 2.3, 2.8), (0.10, 0.45, 0.05), Material.LIT)
            arrow = quads(sheet(middle - 0.25, middle + 0.15, 0.06, 2.48, 2.62), (0.9, 0.9, 0.9), Material.LIT)
            door = quads(sheet(middle + 0.6, middle + 1.6, 0.04, 0.2, 2.25), (0.08, 0.30, 0.08), Material.PAINT)
            box_of_hose = quads(sheet(middle - 1.5, middle - 0.7, 0.04, 0.8, 1.6), (0.05, 0.05, 0.5), Material.PAINT)
            reflector = quads(sheet(begin + 0.1, begin + 0.25, 0.06, 0.8, 0.95), (0.8, 0.8, 0.8), Material.RETRO)
            site.meshes += [green, arrow, door, box_of_hose, reflector]


def _face(site: Site, at_m: float, half_m: float, top_m: float) -> None:
    def across(*corners: tuple[float, float]) -> Doubles:
        """(4, 3) of corners (left, up)."""
        left, up = np.array(corners).T
        return site.road.points(at_m, left, up) - site.origin_m

    pieces = [across((-half_m, HIGH_M), (half_m, HIGH_M), (half_m, top_m), (-half_m, top_m))]
    for side in (-1.0, 1.0):
        near, flat, foot = side * half_m, side * HILL_FLAT_M, side * HILL_FOOT_M
        pieces.append(across((near, -0.3), (flat, -0.3), (flat, top_m), (near, top_m)))
        pieces.append(across((flat, -0.3), (foot, -0.3), (foot, -0.3), (flat, top_m)))
    site.meshes.append(quads(np.array(pieces), PORTAL, Material.CONCRETE))
