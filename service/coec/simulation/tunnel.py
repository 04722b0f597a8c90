"""A tunnel: bare walls and a ceiling close to the lane, a strip of lamps along its middle, a hill around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.simulation.mesh import Material, quads
from coec.simulation.passages import RoadSpan
from coec.simulation.road import Road
from coec.simulation.site import Site

DoublesOfTunnel = NDArray[np.float64]

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

    spine: DoublesOfTunnel
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
    for mouth_m in (span.begin_m, span.end_m):
        if mouth_m in (part.begin_m, part.end_m):
            _face(site, mouth_m, half, top)


def _face(site: Site, at_m: float, half_m: float, top_m: float) -> None:
    def across(*corners: tuple[float, float]) -> DoublesOfTunnel:
        """(4, 3) of corners (left, up)."""
        left, up = np.array(corners).T
        return site.road.points(at_m, left, up) - site.origin_m

    pieces = [across((-half_m, HIGH_M), (half_m, HIGH_M), (half_m, top_m), (-half_m, top_m))]
    for side in (-1.0, 1.0):
        near, flat, foot = side * half_m, side * HILL_FLAT_M, side * HILL_FOOT_M
        pieces.append(across((near, -0.3), (flat, -0.3), (flat, top_m), (near, top_m)))
        pieces.append(across((flat, -0.3), (foot, -0.3), (foot, -0.3), (flat, top_m)))
    site.meshes.append(quads(np.array(pieces), PORTAL, Material.CONCRETE))
