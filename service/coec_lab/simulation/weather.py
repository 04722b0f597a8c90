"""Sun, sky and air of a seed; rain and a low sun: their effects on the air, the light and the lens."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from coec_lab.simulation.mesh import Colour, Floats


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """Light and weather. Colours are linear radiance in blue, green, red; a white wall in full sun is about 1.

    Attributes:
        towards_sun: (3,) float32 unit vector.
        sun: colour of the direct light; 0 under an overcast sky.
        zenith, horizon: colours of the sky.
        clouds: share of the sky that clouds cover.
        haze_m: range after which 63 % of a surface's light is replaced by light of the air.
    """

    towards_sun: Floats
    sun: Colour
    zenith: Colour
    horizon: Colour
    clouds: float
    haze_m: float


def sample_sky(seed: int) -> Sky:
    """The weather of a seed: a quarter of all are overcast, the others have the sun 12° to 65° high."""
    rng = np.random.default_rng([seed, 106])
    height, around = np.deg2rad(rng.uniform(12, 65)), rng.uniform(0, 2 * np.pi)
    towards = np.array([np.cos(height) * np.cos(around), np.cos(height) * np.sin(around), np.sin(height)])
    low = np.clip((0.55 - height) / 0.4, 0, 1)
    if rng.random() < 0.25:
        grey = rng.uniform(0.55, 0.95)
        return Sky(towards.astype(np.float32), (0.0, 0.0, 0.0), (grey * 0.9,) * 3, (grey * 1.02, grey, grey * 0.98),
                   1.0, float(rng.uniform(250, 900)))  # fmt: skip
    power = float(rng.uniform(0.7, 1.1))
    return Sky(
        towards.astype(np.float32),
        (power * (0.88 - 0.45 * low), power * (0.95 - 0.2 * low), power),
        (0.62, 0.40, float(rng.uniform(0.2, 0.3))),
        (0.80, 0.74, float(0.66 + 0.2 * low)),
        float(rng.uniform(0.0, 0.6)),
        float(rng.uniform(350, 1500)),
    )


DROP_M, DROP_REFLECTANCE = 5.0, 0.02
"""Drops that reflect a laser: their mean distance beyond its nearest range (further ones are too weak), and their
reflectance."""
DROPS_PER_MMPH = 6e-4
"""Share of the rays that a drop reflects, per millimetre of rain an hour: 1.5 % at 25 mm/h, the order that published
rain chambers show for automotive sensors."""
WET_MMPH = 5.0
"""Rain that wets a road all over."""
LENS_DROPS_PER_MMPH, LENS_DROP_SHARE = 2.0, (0.008, 0.03)
"""Drops on the lens per millimetre an hour, and their radius as a share of the width of the picture."""
SHOWER_S = 4.0
"""How long drops stay on the lens: the time between two strokes of a wiper."""
SUN_LOW_RAD, SUN_AZIMUTH_RAD = math.radians(5.0), math.radians(8.0)
"""Height of a low sun, and how far to the left of the heading it stands."""
SUN_POWER = (0.45, 0.75, 1.1)
"""Light of a low sun: reddish, as in `sample_sky` at its lowest."""


@dataclass(frozen=True, slots=True)
class Air:
    """The air between a laser and what it hits.

    Attributes:
        extinction_per_m: share of the light that is lost per metre, one way.
        drops: share of the rays that a drop reflects.
        wetness: of the road, 0 dry to 1.
    """

    extinction_per_m: float = 0.0
    drops: float = 0.0
    wetness: float = 0.0


CLEAR = Air()


def rainy_air(mm_per_h: float) -> Air:
    """Air in rain: 1.076 R^0.67 dB/km (Carbonneau and Wisely 1998, for free-space optics)."""
    decibel_per_km = 1.076 * mm_per_h**0.67
    wetness = min(mm_per_h / WET_MMPH, 1.0)
    return Air(math.log(10.0) / 10.0 * decibel_per_km / 1000.0, DROPS_PER_MMPH * mm_per_h, wetness)


def rainy_sky(sky: Sky, mm_per_h: float) -> Sky:
    """The sky of the same place under rain clouds: grey, without sun, hazy."""
    grey = 0.6
    haze_m = min(sky.haze_m, 1.0 / max(rainy_air(mm_per_h).extinction_per_m, 1e-6))
    return replace(
        sky, sun=(0.0, 0.0, 0.0), zenith=(0.9 * grey,) * 3, horizon=(1.02 * grey, grey, 0.98 * grey), clouds=1.0,
        haze_m=haze_m,
    )  # fmt: skip


def rained_lens(shape: tuple[int, int], mm_per_h: float, seed: int, shower: int) -> Floats:
    """(h, w) cover of the lens by drops, 0 to 1; every `shower` has other drops."""
    rng = np.random.default_rng([seed, 121, shower])
    cover = np.zeros(shape, np.float32)
    for _ in range(int(rng.poisson(LENS_DROPS_PER_MMPH * mm_per_h))):
        x, y = rng.uniform(0, shape[1]), rng.uniform(0, shape[0])
        radius = max(round(float(rng.uniform(*LENS_DROP_SHARE)) * shape[1]), 1)
        cv2.circle(cover, (round(x), round(y)), radius, float(rng.uniform(0.5, 0.9)), thickness=-1)
    # Drops on the glass are out of focus.
    return np.asarray(cv2.GaussianBlur(cover, (0, 0), max(shape[1] / 250, 0.5)), np.float32)


def low_sun_sky(sky: Sky, heading_rad: float) -> Sky:
    """The sky of the same place with a low sun ahead of a vehicle with this heading, and few clouds."""
    around = heading_rad + SUN_AZIMUTH_RAD
    towards = np.array(
        [math.cos(SUN_LOW_RAD) * math.cos(around), math.cos(SUN_LOW_RAD) * math.sin(around), math.sin(SUN_LOW_RAD)]
    )
    return replace(
        sky, towards_sun=towards.astype(np.float32), sun=SUN_POWER, zenith=(0.62, 0.40, 0.22),
        horizon=(0.80, 0.74, 0.86), clouds=min(sky.clouds, 0.2),
    )  # fmt: skip
