"""Sun, sky and air of a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coec.simulation.mesh import Colour, Floats


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
