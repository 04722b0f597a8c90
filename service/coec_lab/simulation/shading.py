"""Light on surfaces: sun, sky, headlights and lamps, shadows."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.compiler import PRANGE, njit, prange
from coec_lab.simulation.mesh import Floats, Material
from coec_lab.simulation.passages import SPINE_M
from coec_lab.simulation.reflectance import FOLIAGE, GLASS, LACQUER, LAMP, LIT, SALTS, hashed, noise, texture
from coec_lab.simulation.scene import Hits, Scene
from coec_lab.simulation.weather import Sky

Doubles = NDArray[np.float64]


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
LAMP_LIGHT_M2, LAMP_REACH_M, LAMP_GLOW_M, LAMP_GLOW = 2.0, 25.0, 0.7, 1.5
"""A street lamp: light straight below it times the square of the distance, how far it reaches; within how far its own
head glows, and its light there."""
HEADLIGHT_GAIN = np.ones(len(Material), np.float32)
"""Share of the light of the vehicle's own headlights that comes back to its camera, relative to a matt surface."""
HEADLIGHT_GAIN[[Material.RETRO, Material.BEADED]] = 40.0, 5.0
LIT_RADIANCE = 0.3
"""Radiance of a vehicle's lamp of white colour."""
WINDOW_LIGHT, WINDOWS_LIT = (0.04, 0.08, 0.12), 0.2
"""Radiance of a window with light behind it, and the share of such windows at night."""
NIGHT = 0.002
"""Light of the sky at night over a town, as a share of daylight; a camera sees no colour in it."""


class Incident(NamedTuple):
    """Light at points, float32: `sky_share` (N,) of the sky's light, 0 to 1, and `lamps` (N,), white light of lamps."""

    sky_share: Floats
    lamps: Floats


def incident(scene: Scene, origin_m: Doubles, directions: Floats, hits: Hits) -> Incident:
    """The light, by lamps and tunnels, at the points where rays from `origin_m` (world) hit something."""
    share, lamps = np.ones(len(directions), np.float32), np.zeros(len(directions), np.float32)
    origin = np.asarray(origin_m, np.float64)
    for room in scene.bores:
        _in_bore(origin, directions, hits.range_m, hits.normal, room.spine, room.half_m,
                 room.high_m, room.light, share, lamps)  # fmt: skip
    if len(scene.headlights):
        gain = np.where(hits.triangle < 0, np.float32(1.0), HEADLIGHT_GAIN[scene.material[hits.triangle]])
        _headlit(origin, directions, hits.range_m, hits.normal, scene.headlights, gain, lamps)
        if len(scene.lamps_m):
            _lamplit(origin, directions, hits.range_m, hits.normal, scene.lamps_m, lamps)
    return Incident(share, lamps)


def around(scene: Scene, place_m: Doubles) -> tuple[float, float]:
    """Share of the sky's light, and light of lamps, on a surface at a place (3,), world, that faces down."""
    still = Hits(np.zeros(1, np.float32), np.zeros(1, np.int32), np.array([[0.0, 0.0, -1.0]], np.float32))
    light = incident(scene, place_m, np.array([[0.0, 0.0, 1.0]], np.float32), still)
    return float(light.sky_share[0]), float(light.lamps[0])


def night_sky(sky: Sky) -> Sky:
    """The sky of the same place at night: no sun, hardly any light, the same air."""
    zenith, horizon = (NIGHT * sum(colour) / 3 for colour in (sky.zenith, sky.horizon))
    return replace(sky, sun=(0.0, 0.0, 0.0), zenith=(zenith,) * 3, horizon=(horizon,) * 3)


def headlights(T_world_ego: Matrix4) -> Doubles:
    """(2, 4, 3): for each dipped beam its place and its axes forward, left and up, world."""
    axes = T_world_ego[:3, :3].T
    return np.array(
        [[np.einsum("ij,j->i", T_world_ego[:3, :3], place) + T_world_ego[:3, 3], *axes] for place in HEADLIGHTS_M]
    )


@njit(cache=True, parallel=PRANGE)
def _in_bore(
    origin: Doubles, directions: Floats, range_m: Floats, normal: Floats, spine: Doubles, half_m: float, high_m: float,
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
    origin: Doubles, directions: Floats, range_m: Floats, normal: Floats, beams: Doubles, gain: Floats, lamps: Floats
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
            lamps[i] += gain[i] * BEAM_LIGHT_M2 * beam * facing / squared


@njit(cache=True, parallel=PRANGE)
def _lamplit(
    origin: Doubles, directions: Floats, range_m: Floats, normal: Floats, lamps_m: Doubles, lamps: Floats
) -> None:
    for i in prange(len(directions)):
        r = float(range_m[i])
        if not r < 1e6:
            continue
        px, py, pz = (
            origin[0] + r * directions[i, 0],
            origin[1] + r * directions[i, 1],
            origin[2] + r * directions[i, 2],
        )
        for k in range(len(lamps_m)):
            x, y = lamps_m[k, 0] - px, lamps_m[k, 1] - py
            flat = x * x + y * y
            if flat > LAMP_REACH_M * LAMP_REACH_M:
                continue
            z = lamps_m[k, 2] - pz
            squared = flat + z * z
            if squared < LAMP_GLOW_M * LAMP_GLOW_M:
                lamps[i] += LAMP_GLOW
                continue
            away = math.sqrt(squared)
            facing = (x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2]) / away
            if facing > 0.0 and z > 0.0:
                lamps[i] += LAMP_LIGHT_M2 * (z / away) * facing / squared


DAY_HORIZON = 0.5
"""By day the horizon is brighter than this (`weather.sample_sky`); where it is darker, the skyline is darker, too."""
LAMP_RADIANCE = 2.0
"""Radiance of a visible lamp: white, twice a wall in full sun."""


def shade(
    scene: Scene, origin_m: Doubles, directions: Floats, hits: Hits, shadowed: Floats, pixel_rad: float
) -> Floats:
    """(N, 3) linear radiance in blue, green, red.

    Args:
        origin_m: (3,) origin of the rays, world.
        shadowed: (N,) share of the sunlight that is blocked, 0 to 1.
        pixel_rad: angle between neighbouring rays.
    """
    sky = scene.sky
    out = np.empty((len(directions), 3), np.float32)
    light = incident(scene, origin_m, directions, hits)
    _shade(
        np.asarray(origin_m, np.float64), directions, hits.range_m, hits.triangle, hits.normal, shadowed,
        light.sky_share, light.lamps, scene.colour, scene.material, _light(sky), float(sky.clouds), float(sky.haze_m),
        pixel_rad, out,
    )  # fmt: skip
    return out


def _light(sky: Sky) -> Doubles:
    """(4, 3): direction of the sun, its colour, the zenith's and the horizon's."""
    return np.array([sky.towards_sun, sky.sun, sky.zenith, sky.horizon], np.float64)


@njit(cache=True)
def _sky(x: float, y: float, z: float, light: Doubles, clouds: float, clear: bool, colour: Doubles) -> None:
    """Radiance of the sky in a direction, into `colour`: with a far skyline, and the sun if `clear`."""
    up = max(z, 0.0)
    blend = math.sqrt(up)
    towards = x * light[0, 0] + y * light[0, 1] + z * light[0, 2]
    glow = math.exp(-12.0 * (1.0 - towards)) * 0.5 + math.exp(-180.0 * (1.0 - towards)) * 1.5
    cloud = 0.0
    if clouds > 0.0 and z > 0.02:
        u, v = x / (z + 0.12), y / (z + 0.12)
        amount = (0.5 * noise(1.3 * u, 1.3 * v, SALTS[31]) + 0.3 * noise(3.1 * u, 3.1 * v, SALTS[32])
                  + 0.2 * noise(7.7 * u, 7.7 * v, SALTS[33]))  # fmt: skip
        cloud = min(max((amount - (0.75 - 0.5 * clouds)) * 5.0, 0.0), 1.0)
    for c in range(3):
        value = light[3, c] * (1 - blend) + light[2, c] * blend
        bright = 0.75 * light[3, c] + 0.35 * light[1, c]
        value = value * (1 - 0.8 * cloud) + 0.8 * cloud * bright * (0.8 + 0.3 * blend)
        colour[c] = value + light[1, c] * glow * (1 - 0.6 * cloud)
        if clear and towards > 0.99996 and cloud < 0.5:
            colour[c] += 30.0 * light[1, c]
    far = math.atan2(y, x)
    line = 0.012 + 0.05 * noise(9.0 * far, 0.5, SALTS[34]) + 0.012 * noise(70.0 * far, 0.5, SALTS[35])
    if z < line:
        dark = min(max((line - z) / 0.004, 0.0), 1.0) * 0.55
        lit = min(light[3, 1] / DAY_HORIZON, 1.0)
        colour[0] = colour[0] * (1 - dark) + dark * lit * 0.30
        colour[1] = colour[1] * (1 - dark) + dark * lit * 0.33
        colour[2] = colour[2] * (1 - dark) + dark * lit * 0.27


@njit(cache=True)
def _shininess(kind: int, facing: float) -> float:
    """The share of the light that a surface mirrors, by the cosine of the angle at which it is seen (Schlick 1994)."""
    if kind == GLASS:
        return 0.08 + 0.92 * (1 - facing) ** 5
    if kind == LACQUER:
        return 0.05 + 0.6 * (1 - facing) ** 5
    return 0.0


@njit(cache=True)
def _reflect(
    kind: int, shiny: float, dx: float, dy: float, dz: float, nx: float, ny: float, nz: float, u: float, v: float,
    light: Doubles, clouds: float, sky_share: float, shadowed: float, colour: Doubles,
) -> None:  # fmt: skip
    """Mixes into `colour` what a surface mirrors of the sky, of what stands opposite, and of the sun: the share `shiny`
    of a ray along d onto the normal n at its coordinates u, v."""
    along = 2.0 * (nx * dx + ny * dy + nz * dz)
    rx, ry, rz = dx - along * nx, dy - along * ny, dz - along * nz
    mirrored = np.empty(3)
    if rz > 0.25 or (kind == LACQUER and rz > 0.02):
        _sky(rx, ry, rz, light, clouds, False, mirrored)
    else:  # what stands opposite, a blotch
        shade_of = 0.10 + 0.25 * noise(0.35 * u + 3 * rx, 0.35 * v + 3 * rz, SALTS[40])
        for c in range(3):
            mirrored[c] = shade_of * (light[3, c] + 0.3 * light[1, c])
    for c in range(3):
        mirrored[c] *= sky_share
    glint = rx * light[0, 0] + ry * light[0, 1] + rz * light[0, 2]
    spot = 6.0 * max(glint, 0.0) ** 400 * (1.0 - shadowed) if glint > 0.9 else 0.0
    for c in range(3):
        colour[c] = colour[c] * (1 - shiny) + shiny * mirrored[c] + spot * light[1, c]


@njit(cache=True)
def _emit(kind: int, paint: Floats, colour: Doubles) -> None:
    """Adds to `colour` the light of lamps, and of windows with light behind them."""
    if kind == LAMP:
        for c in range(3):
            colour[c] = LAMP_RADIANCE
    elif kind == LIT:
        for c in range(3):
            colour[c] += LIT_RADIANCE * paint[c]
    # Each pane has a tone of its own, which says whether there is light behind it.
    elif hashed(np.int64(paint[0] * 1e5), np.int64(paint[2] * 1e5), SALTS[41]) < WINDOWS_LIT:
        for c in range(3):
            colour[c] += WINDOW_LIGHT[c]


@njit(cache=True, parallel=PRANGE)
def _shade(
    origin: Doubles,
    directions: Floats,
    range_m: Floats,
    triangle: NDArray[np.int32],
    normal: Floats,
    shadowed: Floats,
    sky_share: Floats,
    lamps: Floats,
    paint: Floats,
    material: NDArray[np.int8],
    light: Doubles,
    clouds: float,
    haze_m: float,
    pixel_rad: float,
    out: Floats,
) -> None:
    dark = light[3, 1] < 5.0 * NIGHT
    for i in prange(len(directions)):
        dx, dy, dz = float(directions[i, 0]), float(directions[i, 1]), float(directions[i, 2])
        colour = np.empty(3)
        t = triangle[i]
        if t < 0:
            _sky(dx, dy, dz, light, clouds, True, colour)
            for c in range(3):
                out[i, c] = colour[c]
            continue
        r = float(range_m[i])
        nx, ny, nz = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        x, y, z = origin[0] + r * dx, origin[1] + r * dy, origin[2] + r * dz
        facing = max(-(nx * dx + ny * dy + nz * dz), 0.02)
        foot = r * pixel_rad / math.sqrt(facing)
        if abs(nz) > 0.7:
            u, v = x, y
        else:
            flat = math.sqrt(nx * nx + ny * ny)
            u, v = (ny * x - nx * y) / flat, z
        kind = material[t]
        shiny = _shininess(kind, facing)
        factor = 1.0 if kind in (GLASS, LACQUER) else texture(kind, u, v, foot)
        sunny = max(nx * light[0, 0] + ny * light[0, 1] + nz * light[0, 2], 0.0)
        if kind == FOLIAGE:
            sunny = 0.35 + 0.5 * sunny  # leaves face all directions and let light through
        sunny *= 1.0 - shadowed[i]
        open_sky = 0.62 + 0.38 * nz
        # Walls get less light of the sky, and the ground reflects sunlight from below.
        if abs(nz) < 0.7:
            open_sky *= 0.72
        for c in range(3):
            ambient = 0.55 * (light[2, c] + light[3, c]) * 0.5 * open_sky + 0.06 * light[1, c] * (1 - 0.5 * nz)
            colour[c] = paint[t, c] * factor * (light[1, c] * sunny + ambient * sky_share[i] + lamps[i])
        if shiny > 0.0:
            _reflect(kind, shiny, dx, dy, dz, nx, ny, nz, u, v, light, clouds, sky_share[i], shadowed[i], colour)
        if kind in (LAMP, LIT) or (kind == GLASS and dark and abs(nz) < 0.05):
            _emit(kind, paint[t], colour)
        air = math.exp(-r / haze_m)
        for c in range(3):  # the air shines with the light that falls into it
            out[i, c] = colour[c] * air + (1 - air) * light[3, c] * 0.95 * sky_share[i]
