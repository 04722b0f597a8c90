"""Light of lamps in tunnels and of headlights at night, and how little of the sky's light reaches into a tunnel."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.compiler import PRANGE, njit, prange
from coec.simulation.mesh import Floats
from coec.simulation.scene import Hits, Scene
from coec.simulation.sky import Sky
from coec.simulation.tunnel import SPINE_M

DoublesOfLamps = NDArray[np.float64]

# Unit of light: that of the sun on a white wall, as in `Sky`.
MOUTH_SHARE, MOUTH_DEPTH_M = 0.5, 7.0
"""Share of the sky's light just inside a tunnel, and the depth after which 1/e of it is left: the tunnel's width."""
STRIP_LIGHT, STRIP_BOUNCE = 0.05, 0.006
"""Direct light of the strip of lamps, times metres over distance, and what walls and road scatter everywhere. Some
1 % of daylight: lit tunnels have 50 to 300 lx beyond the zone at their mouths, an overcast day 10,000 (CIE 88)."""
HEADLIGHTS_M = ((3.45, 0.65, 0.65), (3.45, -0.65, 0.65))
"""Places of the headlights in the ego frame."""
BEAM_LIGHT_M2, BEAM_SPILL = 12.0, 0.02
"""A dipped beam: light on its axis times the square of the distance, and the share that goes everywhere ahead."""
BEAM_DOWN_RAD, BEAM_WIDE_RAD, BEAM_HIGH_RAD, BEAM_CUT_RAD = 0.02, 0.45, 0.14, 0.015
"""How far its axis points below the horizon; its width to the sides, below and above the axis, to 1/e of the light."""
NIGHT = 0.002
"""Light of the sky at night over a town, as a share of daylight; a camera sees no colour in it."""


class Incident(NamedTuple):
    """Light at points, float32: `sky_share` (N,) of the sky's light, 0 to 1, and `lamps` (N,), white light of lamps."""

    sky_share: Floats
    lamps: Floats


def incident(scene: Scene, origin_m: DoublesOfLamps, directions: Floats, hits: Hits) -> Incident:
    """The light, by lamps and tunnels, at the points where rays from `origin_m` (world) hit something."""
    share, lamps = np.ones(len(directions), np.float32), np.zeros(len(directions), np.float32)
    origin = np.asarray(origin_m, np.float64)
    for room in scene.bores:
        _in_bore(origin, directions, hits.range_m, hits.normal, room.spine, room.half_m,
                 room.high_m, room.light, share, lamps)  # fmt: skip
    if len(scene.headlights):
        _headlit(origin, directions, hits.range_m, hits.normal, scene.headlights, lamps)
    return Incident(share, lamps)


def around(scene: Scene, place_m: DoublesOfLamps) -> tuple[float, float]:
    """Share of the sky's light, and light of lamps, on a surface at a place (3,), world, that faces down."""
    still = Hits(np.zeros(1, np.float32), np.zeros(1, np.int32), np.array([[0.0, 0.0, -1.0]], np.float32))
    light = incident(scene, place_m, np.array([[0.0, 0.0, 1.0]], np.float32), still)
    return float(light.sky_share[0]), float(light.lamps[0])


def night_sky(sky: Sky) -> Sky:
    """The sky of the same place at night: no sun, hardly any light, the same air."""
    zenith, horizon = (NIGHT * sum(colour) / 3 for colour in (sky.zenith, sky.horizon))
    return replace(sky, sun=(0.0, 0.0, 0.0), zenith=(zenith,) * 3, horizon=(horizon,) * 3)


def headlights(T_world_ego: Matrix4) -> DoublesOfLamps:
    """(2, 4, 3): for each dipped beam its place and its axes forward, left and up, world."""
    axes = T_world_ego[:3, :3].T
    return np.array(
        [[np.einsum("ij,j->i", T_world_ego[:3, :3], place) + T_world_ego[:3, 3], *axes] for place in HEADLIGHTS_M]
    )


@njit(cache=True, parallel=PRANGE)
def _in_bore(
    origin: DoublesOfLamps, directions: Floats, range_m: Floats, normal: Floats, spine: DoublesOfLamps, half_m: float, high_m: float,
    light: float, share: Floats, lamps: Floats,
) -> None:  # fmt: skip
    last = len(spine) - 1
    for i in prange(len(directions)):
        r = float(range_m[i])
        if not r < 1e6:
            continue
        x, y, z = origin[0] + r * directions[i, 0], origin[1] + r * directions[i, 1], origin[2] + r * directions[i, 2]
        # Newton's steps find the place on the road whose cross-section holds the point; the road always goes on in x.
        place = (x - spine[0, 0]) / (spine[last, 0] - spine[0, 0]) * last
        j = 0
        for _ in range(6):
            j = int(min(max(round(place), 0), last))
            along = (x - spine[j, 0]) * spine[j, 3] + (y - spine[j, 1]) * spine[j, 4]
            place = j + along / SPINE_M
        left = (y - spine[j, 1]) * spine[j, 3] - (x - spine[j, 0]) * spine[j, 4]
        up = z - spine[j, 2]
        # With a margin, because walls are straight between the points of their mesh, and the spine is not.
        if place < 0.0 or place > last or abs(left) > half_m + 0.1 or up > high_m + 0.05:
            continue
        deep_m = SPINE_M * min(place, last - place)
        share[i] = min(share[i], MOUTH_SHARE * math.exp(-deep_m / MOUTH_DEPTH_M))
        above = max(high_m - up, 0.0)
        away = max(math.sqrt(left * left + above * above), 0.3)
        sideways = normal[i, 1] * spine[j, 3] - normal[i, 0] * spine[j, 4]
        facing = max((above * normal[i, 2] - left * sideways) / away, 0.0)
        lamps[i] += light * (STRIP_LIGHT * facing / away + STRIP_BOUNCE)


@njit(cache=True, parallel=PRANGE)
def _headlit(
    origin: DoublesOfLamps, directions: Floats, range_m: Floats, normal: Floats, beams: DoublesOfLamps, lamps: Floats
) -> None:
    for i in prange(len(directions)):
        r = float(range_m[i])
        if not r < 1e6:
            continue
        for k in range(len(beams)):
            x = origin[0] + r * directions[i, 0] - beams[k, 0, 0]
            y = origin[1] + r * directions[i, 1] - beams[k, 0, 1]
            z = origin[2] + r * directions[i, 2] - beams[k, 0, 2]
            ahead = x * beams[k, 1, 0] + y * beams[k, 1, 1] + z * beams[k, 1, 2]
            if ahead <= 0.0:
                continue
            left = x * beams[k, 2, 0] + y * beams[k, 2, 1] + z * beams[k, 2, 2]
            up = x * beams[k, 3, 0] + y * beams[k, 3, 1] + z * beams[k, 3, 2]
            squared = max(x * x + y * y + z * z, 0.25)
            facing = -(x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2]) / math.sqrt(squared)
            if facing <= 0.0:
                continue
            across = math.atan2(left, ahead) / BEAM_WIDE_RAD
            over = math.atan2(up, math.sqrt(ahead * ahead + left * left)) + BEAM_DOWN_RAD
            over /= BEAM_CUT_RAD if over > 0.0 else BEAM_HIGH_RAD
            beam = math.exp(-across * across - over * over) + BEAM_SPILL
            lamps[i] += BEAM_LIGHT_M2 * beam * facing / squared
