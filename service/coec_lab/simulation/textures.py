"""Textures of the materials, for the camera and the laser: factors on the brightness of a surface at a place.

They are sums of value noise (Perlin, "An image synthesizer", SIGGRAPH 1985, with hashed lattice values) at places in
the world. Each octave fades out before a pixel covers its wavelength, so that unresolved detail does not flicker.
"""

import math

import numpy as np

from coec.geometry.compiler import njit

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
