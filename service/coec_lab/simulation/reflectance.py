"""Strength of a LiDAR's returns: what surfaces reflect at 905 nm, and the value that a sensor writes for it.

What is dark for a camera need not be dark for a laser: leaves and most dyes are bright, carbon black and clear glass
are not, and a shadow does not exist. Levels, scatter and differences between beams are those of real sensors (page
"Simulate a vehicle").

Textures, for the camera and the laser, are factors on the brightness of a surface at a place: sums of value noise
(Perlin, "An image synthesizer", SIGGRAPH 1985, with hashed lattice values) at places in the world. Each octave fades
out before a pixel covers its wavelength, so that unresolved detail does not flicker.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coec.geometry.compiler import njit
from coec_lab.simulation.mesh import Floats, Material

# The numbers of `Material`, as constants of the compiled code.
ASPHALT, PAVING, GRASS, BRICK, PLASTER, GLASS, LACQUER, FOLIAGE, BARK, TILES, MARKING = range(1, 12)
RUBBER, CONCRETE = 13, 14
LAMP, RETRO, BEADED, LIT = range(16, 20)

SALTS = np.arange(64)
"""Numbers that make one noise differ from another. They are in an array because the compiler compiles a function anew
for every literal number with which it is called, but not for every entry of an array."""


@njit(cache=True, inline="always")
def hashed(i: np.int64, j: np.int64, salt: int) -> float:
    """A hash from 0 to 1 for an integer cell."""
    h = (np.uint32(i) * np.uint32(0x8DA6B343)) ^ (np.uint32(j) * np.uint32(0xD8163841)) ^ np.uint32(salt)
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    return float((h ^ (h >> np.uint32(15))) >> np.uint32(8)) * (1.0 / 16777216.0)


@njit(cache=True)
def noise(u: float, v: float, salt: int) -> float:
    """Value noise, 0 to 1, of wavelength 1."""
    fu, fv = math.floor(u), math.floor(v)
    i, j = np.int64(fu), np.int64(fv)
    a, b = u - fu, v - fv
    a = a * a * (3.0 - 2.0 * a)
    b = b * b * (3.0 - 2.0 * b)
    low = hashed(i, j, salt) * (1 - a) + hashed(i + np.int64(1), j, salt) * a
    high = hashed(i, j + np.int64(1), salt) * (1 - a) + hashed(i + np.int64(1), j + np.int64(1), salt) * a
    return low * (1 - b) + high * b


@njit(cache=True)
def octave(u: float, v: float, wave_m: float, footprint_m: float, salt: int) -> float:
    """Noise about 0 (-0.5 to 0.5) of one wavelength, faded where it cannot be resolved."""
    fade = 1.5 - 2.0 * footprint_m / wave_m
    if fade <= 0.0:
        return 0.0
    return min(fade, 1.0) * (noise(u / wave_m, v / wave_m, salt) - 0.5)


@njit(cache=True)
def line(u: float, period_m: float, width_m: float, footprint_m: float) -> float:
    """Share of a pixel that lies in lines of this width that repeat along u, 0 to 1."""
    place = abs(u - period_m * math.floor(u / period_m) - 0.5 * period_m)
    place = 0.5 * period_m - place  # distance to the nearest line
    wide = 0.5 * max(width_m, footprint_m)
    cover = 0.0 if place > wide + 0.5 * footprint_m else min(1.0, width_m / (2.0 * wide))
    blend = min(1.0, footprint_m / (0.5 * period_m))
    return cover * (1 - blend) + blend * width_m / period_m


@njit(cache=True)
def texture(kind: int, u: float, v: float, foot: float) -> float:
    """Factor on the colour of a surface at its coordinates u, v (m; v is the height on walls)."""
    if kind == ASPHALT:
        return (1.0 + 0.5 * octave(u, v, 0.04, foot, SALTS[1]) + 0.3 * octave(u, v, 0.25, foot, SALTS[2])
                + 0.3 * octave(u, v, 2.5, foot, SALTS[3]) + 0.2 * octave(u, v, 11.0, foot, SALTS[4]))  # fmt: skip
    if kind == PAVING:
        joint = max(line(u, 0.5, 0.02, foot), line(v, 0.5, 0.02, foot))
        slab = hashed(np.int64(math.floor(u / 0.5)), np.int64(math.floor(v / 0.5)), 5) - 0.5
        fade = max(0.0, min(1.0, 1.5 - 2 * foot / 0.5))
        return (1.0 - 0.5 * joint) * (1.0 + 0.22 * fade * slab + 0.3 * octave(u, v, 0.1, foot, SALTS[6])
                                      + 0.25 * octave(u, v, 3.0, foot, SALTS[7]))  # fmt: skip
    if kind == GRASS:
        return (1.0 + 0.8 * octave(u, v, 0.07, foot, SALTS[8]) + 0.6 * octave(u, v, 0.4, foot, SALTS[9])
                + 0.5 * octave(u, v, 2.0, foot, SALTS[10]) + 0.4 * octave(u, v, 9.0, foot, SALTS[11]))  # fmt: skip
    if kind == BRICK:
        row = math.floor(v / 0.08)
        shifted = u + 0.12 * (row - 2 * math.floor(row / 2))
        joint = max(line(v, 0.08, 0.012, foot), line(shifted, 0.24, 0.012, foot))
        brick = hashed(np.int64(math.floor(shifted / 0.24)), np.int64(row), 12) - 0.5
        fade = max(0.0, min(1.0, 1.5 - 2 * foot / 0.1))
        return (1.0 + 0.35 * joint) * (1.0 + 0.5 * fade * brick + 0.3 * octave(u, v, 1.7, foot, SALTS[13]))
    if kind in (PLASTER, CONCRETE):
        return (1.0 + 0.15 * octave(u, v, 0.05, foot, SALTS[14]) + 0.12 * octave(u, v, 0.6, foot, SALTS[15])
                + 0.22 * octave(u, 0.4 * v, 2.4, foot, SALTS[16]))  # fmt: skip
    if kind == FOLIAGE:
        return 1.0 + 0.9 * octave(u, v, 0.12, foot, SALTS[17]) + 0.7 * octave(u, v, 0.5, foot, SALTS[18])
    if kind == BARK:
        return 1.0 + 0.8 * octave(4 * u, v, 0.2, foot, SALTS[19])
    if kind == TILES:
        return (1.0 - 0.45 * max(line(v, 0.3, 0.04, foot), 0.6 * line(u, 0.22, 0.03, foot))) * (
            1.0 + 0.3 * octave(u, v, 0.3, foot, SALTS[20]) + 0.3 * octave(u, v, 2.0, foot, SALTS[21])
        )
    if kind in (MARKING, BEADED):
        worn = octave(u, v, 0.3, foot, SALTS[22]) + octave(u, v, 0.05, foot, SALTS[23])
        return 1.0 + 0.35 * worn
    return 1.0 + 0.08 * octave(u, v, 0.6, foot, SALTS[24])


Doubles = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class IntensityModel:
    """How a sensor turns the power of a return into a number.

    A return has the relative power s / (r² + `near_m`²), where s is the reflectance times the cosine's power.

    Attributes:
        full: largest value.
        step: values are multiples of it.
        white: value of a white surface, s = 1. Brighter ones, retro-reflectors, reach `full` at s = `retro`.
        gamma: exponent of s below white.
        counts: photons at a relative power of 1: the value itself, without correction for range; 0 for a sensor that
            corrects for range.
        near_m: range within which the power rises no further, because the lens is focused far away.
        cutoff: relative power below which a corrected value is 0.
        shot, relative: variance of the value over its square is shot / power + relative².
        beam_sigma, weak_beams: logarithmic spread of the beams' gains; share of beams with less than 60 % of theirs.
    """

    full: float
    step: float
    white: float
    retro: float = 8.0
    gamma: float = 1.0
    counts: float = 0.0
    near_m: float = 0.0
    cutoff: float = 0.0
    shot: float = 0.0
    relative: float = 0.03
    beam_sigma: float = 0.03
    weak_beams: float = 0.0


INTENSITIES: Mapping[str, IntensityModel | None] = MappingProxyType(
    {
        "calibrated": IntensityModel(
            255.0, 1.0, 190.0, gamma=0.45, cutoff=6e-5, shot=7e-6, relative=0.06, beam_sigma=0.1, weak_beams=0.08
        ),
        "reflectivity": IntensityModel(255.0, 1.0, 100.0, retro=60.0, cutoff=1e-5, shot=1e-6, relative=0.025),
        "raw": IntensityModel(65535.0, 1.0, 0.0, counts=1e5, near_m=6.0, shot=1.3e-5, relative=0.06, beam_sigma=0.05),
        "coarse": IntensityModel(1.0, 1 / 64, 0.85, retro=1.5, gamma=0.7, shot=2e-6, relative=0.03, beam_sigma=0.02),
        "none": None,
    }
)
"""Kinds of sensors: 0 to 255 corrected for range, with old calibrations of 64 lasers (HDL-64E); 0 to 100 for diffuse
surfaces and up to 255 for retro-reflectors (VLP-16); photons in 16 bits (Ouster `signal`); 0 to 1 in 64 steps
(solid state); and none."""

GLOSS, GLOSS_POWER = 0.5, 60
"""Lobe of lacquer and steel seen head on."""
SATURATED = 2.0
"""Returns stronger than this times a white surface bloom."""
GHOST = 15.0
"""From this strength on the neighbours measure the range of the retro-reflector, too."""
BLOOM = (0.08, 0.004)
"""Share of a saturated return that the next firing of the same beam receives, and the one after it."""
WET_SHARE, WET_LOSS = 0.45, 0.5
"""A wet road reflects this share of a dry one; share of the returns lost at grazing incidence."""


def _of_materials(others: float, **values: float) -> Doubles:
    """(materials,) values by name of material."""
    table = np.full(len(Material), others)
    for name, value in values.items():
        table[Material[name]] = value
    return table


_OWN_SHARE = _of_materials(0.4, PLASTER=0.3, CONCRETE=0.3, PAVING=0.3, BRICK=0.5, TILES=0.5, CLOTH=0.8, BARK=0.7)
"""Share of a surface's infrared reflectance that its visible colour does not tell."""
_OWN_LOW = _of_materials(0.2, PLASTER=0.3, CONCRETE=0.25, PAVING=0.25, BRICK=0.35, TILES=0.3, BARK=0.3)
_OWN_HIGH = _of_materials(0.8, PLASTER=0.7, CONCRETE=0.45, PAVING=0.4, BRICK=0.6, TILES=0.5, BARK=0.5, CLOTH=0.75)
_FIXED = _of_materials(
    np.nan, ASPHALT=0.17, GRASS=0.45, FOLIAGE=0.5, RUBBER=0.05, GLASS=0.03, MARKING=0.5, BEADED=0.5, LAMP=0.3,
    LIT=0.3,
)  # fmt: skip
_COSINE_POWER = _of_materials(
    1.0, ASPHALT=0.25, PAVING=0.3, GRASS=0.2, FOLIAGE=0.2, BRICK=0.6, PLASTER=0.8, CONCRETE=0.7, CLOTH=0.5, BARK=0.4,
    MARKING=0.3, BEADED=0.2,
)  # fmt: skip
"""Rough surfaces reflect much of the light back to where it comes from, even at grazing incidence."""
_RETRO = _of_materials(0.0, SIGN=10.0, RETRO=60.0, BEADED=0.4, LIT=6.0)
"""Light that is sent back, times a white surface's."""
_TEXTURE = _of_materials(
    0.5, ASPHALT=0.4, PAVING=0.7, BRICK=0.7, TILES=0.7, FOLIAGE=0.8, BARK=0.6, MARKING=0.8, BEADED=0.8, CONCRETE=0.6,
)  # fmt: skip
"""Contrast of a texture for the laser, relative to that for the camera."""
_BLOTCH, _BLOTCH_M = 0.15, 0.8
"""Contrast and size of blotches that only the laser sees: damp, dust, old paint."""
_STAIN, _STAIN_M, _STAIN_FROM = 0.35, 2.5, 0.12
"""What stains that only the laser sees take away, their size, and from which level of their noise on there is one."""
_AGEING, _AGEING_M = 1.0, 40.0
"""Blotches of painted markings, whose beads wear off before the paint does."""
_SPECKLE = _of_materials(0.0, FOLIAGE=0.4, GRASS=0.25, BARK=0.25, CLOTH=0.1)
"""Spread of the strength from one firing to the next, where a beam hits another share of leaves and blades."""
SPILL = 0.15
"""Share of a firing's light that comes from where the one beside it looks: beams are as wide as their spacing."""
HEAVY = (0.5, 0.36)
"""Noise is normal with the scale HEAVY[0] + HEAVY[1] times the square of another normal variable: some firings are much
worse than others, as on real sensors. Its variance is 1."""
_WETTED = np.isin(np.arange(len(Material)), [Material.ASPHALT, Material.PAVING, Material.CONCRETE, Material.MARKING,
                                             Material.BEADED])  # fmt: skip
CARBON_BLACK, CARBON_SHARE = 0.06, 0.7
"""Paint darker than this has carbon black as its pigment, this share of it, and is as dark for a laser."""


def infrared(colour: Floats, material: NDArray[np.int8]) -> Floats:
    """(T,) reflectance at 905 nm of surfaces of these colours (T, 3) and materials (T,).

    The part that a colour does not tell follows from a hash of it, so it is the same all over an object.
    """
    seen = colour.mean(axis=1, dtype=np.float64)
    lot = _lot(colour)
    own = _OWN_LOW[material] + (_OWN_HIGH - _OWN_LOW)[material] * lot
    share = _OWN_SHARE[material]
    result = (1 - share) * seen + share * own
    painted = np.isin(material, [Material.PAINT, Material.LACQUER])
    black = painted & (seen < CARBON_BLACK) & (lot < CARBON_SHARE)
    result[black] = 0.02 + 0.5 * seen[black]
    fixed = _FIXED[material]
    is_fixed = ~np.isnan(fixed)
    # Mended asphalt, faded paint and young leaves differ for the laser as well, but less.
    typical = np.array([0.19, 0.16, 0.13])
    for kind, grey in zip((Material.ASPHALT, Material.GRASS, Material.FOLIAGE), typical, strict=True):
        fixed = np.where(material == kind, fixed * (0.5 + 0.5 * np.clip(seen / grey, 0.3, 1.7)), fixed)
    result[is_fixed] = fixed[is_fixed]
    sheet = np.isin(material, [Material.SIGN, Material.RETRO])
    result[sheet] = colour[sheet].max(axis=1) ** 1.5  # print on sheeting hides what reflects
    return np.asarray(result, np.float32)


def _lot(colour: Floats) -> Doubles:
    """(T,) hash of colours (T, 3), 0 to 1."""
    cell = np.rint(colour.astype(np.float64) * 1000).astype(np.uint32)
    mixed = cell[:, 0] * np.uint32(73856093) ^ cell[:, 1] * np.uint32(19349663) ^ cell[:, 2] * np.uint32(83492791)
    mixed = (mixed ^ (mixed >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    return np.asarray((mixed ^ (mixed >> np.uint32(12))) / 2.0**32)


def strength(reflectance: Floats, material: NDArray[np.int8], cosine: Doubles) -> Doubles:
    """(N,) strength of returns, 1 for a white surface head on.

    Args:
        reflectance: (N,) see `infrared`.
        cosine: (N,) of the angle of incidence.
    """
    diffuse = np.maximum(cosine, 0.02) ** _COSINE_POWER[material] + _RETRO[material] * cosine**2
    shiny = (material == Material.LACQUER) | (material == Material.STEEL)
    head_on = np.flatnonzero(shiny & (cosine > 0.9))
    result = reflectance * diffuse
    result[head_on] += GLOSS * cosine[head_on] ** GLOSS_POWER
    return np.asarray(result)


class Surfaces(NamedTuple):
    """Where N rays end, for those that hit something.

    Attributes:
        origins_m, directions: (N, 3) world, float64.
        range_m: (N,) float32.
        normal: (N, 3).
        cosine: (N,) of the angle of incidence.
        material: (N,).
    """

    origins_m: Doubles
    directions: Doubles
    range_m: Floats
    normal: Floats
    cosine: Doubles
    material: NDArray[np.int8]

    def wetted(self) -> NDArray[np.bool_]:
        """(N,): level ground that rain makes wet."""
        return np.asarray(_WETTED[self.material] & (np.abs(self.normal[:, 2]) > 0.7))


def shade(
    light: Doubles, lit: NDArray[np.bool_], at: Surfaces, divergence_rad: float, wetness: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Multiplies light (N,), where `lit`, by the texture of the material, blotches, stains, speckle and water.

    Args:
        divergence_rad: half the opening angle of a beam.
        wetness: 0 dry to 1.
    """
    _textured(at.origins_m, at.directions, at.range_m, at.normal, at.cosine, at.material, lit, 2.0 * divergence_rad,
              _TEXTURE, light)  # fmt: skip
    rough = np.flatnonzero(lit & (_SPECKLE > 0)[at.material])
    light[rough] *= np.exp(_SPECKLE[at.material[rough]] * rng.standard_normal(len(rough)))
    if wetness:
        light[at.wetted()] *= 1.0 - wetness * (1.0 - WET_SHARE)


@njit(cache=True, nogil=True)
def _textured(
    origins: Doubles, directions: Doubles, range_m: Floats, normal: Floats, cosine: Doubles,
    material: NDArray[np.int8], lit: NDArray[np.bool_], wide_rad: float, contrast: Doubles, light: Doubles,
) -> None:  # fmt: skip
    for i in range(len(light)):
        if not lit[i]:
            continue
        r = float(range_m[i])
        nx, ny, nz = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        x, y, z = (
            origins[i, 0] + r * directions[i, 0], origins[i, 1] + r * directions[i, 1],
            origins[i, 2] + r * directions[i, 2],
        )  # fmt: skip
        if abs(nz) > 0.7:
            u, v = x, y
        else:
            flat = math.sqrt(nx * nx + ny * ny)
            u, v = (ny * x - nx * y) / flat, z
        foot = wide_rad * r / math.sqrt(max(cosine[i], 0.02))
        kind = material[i]
        seen = texture(kind, u, v, foot) - 1.0
        own = 2.0 * _BLOTCH * octave(u, v, _BLOTCH_M, foot, SALTS[45])
        if octave(u, v, _STAIN_M, foot, SALTS[47]) > _STAIN_FROM:
            own -= _STAIN
        if kind in (MARKING, BEADED):
            own += _AGEING * octave(u, v, _AGEING_M, foot, SALTS[46])
        light[i] *= max(1.0 + contrast[kind] * seen + own, 0.1)


def lost_on_water(at: Surfaces, wetness: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(N,): returns that a wet road mirrors away from the sensor."""
    share = wetness * WET_LOSS * (1.0 - at.cosine) ** 8
    return np.asarray(at.wetted() & (rng.random(len(at.cosine)) < share))


def beam_gains(model: IntensityModel, beams: int, rng: np.random.Generator) -> Doubles:
    """(beams,) what is left after calibration of the differences between beams, as factors on values."""
    gains = np.exp(rng.normal(0.0, model.beam_sigma, beams))
    weak = rng.random(beams) < model.weak_beams
    gains[weak] *= rng.uniform(0.3, 0.7, int(weak.sum()))
    return gains


class Halo(NamedTuple):
    """Light of saturated returns that neighbouring firings receive. Indices are flat.

    Attributes:
        raised, by: whose light rises, and by how much.
        ghosts, sources, ghost_light: firings that return from the range of a retro-reflector instead of their own, the
            retro-reflector, and their light.
    """

    raised: NDArray[np.intp]
    by: Doubles
    ghosts: NDArray[np.intp]
    sources: NDArray[np.intp]
    ghost_light: Doubles


def spill(light: Doubles, range_m: Doubles, within_m: float) -> Doubles:
    """The light (columns, beams) with a share of that of the firings beside it, where these hit the same surface; other
    arguments as of `bloom`."""
    same = np.zeros((len(light) + 1, light.shape[1]), bool)
    with np.errstate(invalid="ignore"):
        same[1:-1] = np.abs(np.diff(range_m, axis=0)) < within_m
    same[1:-1] &= (light[1:] > 0) & (light[:-1] > 0)
    mixed = light.copy()
    step = np.where(same[1:-1], SPILL * np.diff(light, axis=0), 0.0)
    mixed[:-1] += step
    mixed[1:] -= step
    return mixed


def bloom(light: Doubles, range_m: Doubles, within_m: float) -> Halo:
    """What retro-reflectors do to the firings of the same beam beside them.

    Args:
        light: (columns, beams) strengths, 0 without a return.
        range_m: (columns, beams), inf without one.
        within_m: echoes nearer to each other are one.
    """
    columns, width = light.shape
    at, beam = np.nonzero(light > SATURATED)
    near_m, bright = range_m[at, beam], light[at, beam]
    raised, ghosts = [], []
    for distance, share in enumerate(BLOOM, start=1):
        for sign in (-1, 1):
            other = (at + sign * distance) % columns
            own_m, halo = range_m[other, beam], share * bright
            together = np.abs(own_m - near_m) < within_m
            own = light[other, beam] / np.maximum(own_m, 0.1) ** 2
            taken = ~together & (bright > GHOST) & (halo / near_m**2 > own)
            index, source = other * width + beam, at * width + beam
            raised.append(np.stack([index[together], halo[together]]))
            ghosts.append(np.stack([index[taken], source[taken], halo[taken]]))
    (raised_at, by), (ghost, source, dim) = np.concatenate(raised, axis=1), np.concatenate(ghosts, axis=1)
    return Halo(raised_at.astype(np.intp), by, ghost.astype(np.intp), source.astype(np.intp), dim)


def values(model: IntensityModel, power: Doubles, range_m: Doubles, gain: Doubles, rng: np.random.Generator) -> Floats:
    """(N,) values that the sensor writes.

    Args:
        power: (N,) strengths, see `strength`.
        range_m: (N,).
        gain: (N,) of each return's beam.
    """
    received = power / (range_m**2 + model.near_m**2)
    scale = HEAVY[0] + HEAVY[1] * rng.standard_normal(len(power)) ** 2
    noise = (
        rng.standard_normal(len(power)) * scale * np.sqrt(model.shot / np.maximum(received, 1e-9) + model.relative**2)
    )
    if model.counts:
        level = model.counts * received
    else:
        above = (model.full - model.white) * np.log(np.maximum(power, 1.0)) / math.log(model.retro)
        level = model.white * np.minimum(power, 1.0) ** model.gamma + above
    level = level * gain * (1.0 + noise)
    if model.cutoff:
        level[received * (1.0 + noise) < model.cutoff] = 0.0
    return (model.step * np.rint(np.clip(level, 0.0, model.full) / model.step)).astype(np.float32)
