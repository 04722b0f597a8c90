"""From the light at the lens to the bytes of a picture: blur, vignetting, gain, noise, dirt, JPEG."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.simulation.mesh import Floats
from coec.simulation.render import tone


@dataclass(frozen=True, slots=True)
class LensProperties:
    """How a camera degrades a picture.

    Attributes:
        blur_px: standard deviation of the point spread at full sharpness, pixels.
        vignetting: share of the light that is lost at the rim.
        full_well: electrons at full exposure; shot noise is its square root.
        read_noise: standard deviation as a share of full exposure.
        target: mean level to which the exposure is controlled, linear, 0 to 1.
        gain: least and greatest factor on the light.
        jpeg_quality: 1 to 100.
        flare: share of the light that the glass scatters over the whole picture.
    """

    blur_px: float = 0.55
    vignetting: float = 0.35
    full_well: float = 6000.0
    read_noise: float = 0.003
    target: float = 0.22
    gain: tuple[float, float] = (0.15, 8.0)
    jpeg_quality: int = 90
    flare: float = 0.0


NIGHT_BLUR_PX, NIGHT_NOISE, NIGHT_FULL_WELL = 1.5, 1.5, 0.25
"""At night: point spread of an exposure of 30 ms while driving, pixels; factors on the read noise and on the electrons
of full exposure, as for a sensor at 4 times its usual sensitivity."""
LOW_SUN_FLARE, FLARE_LIGHT, FLARE_SPREAD = 0.15, 30.0, 0.12
"""For a lens with the sun in it: the scattered share of the light, the light at which scattering saturates (the sun's
disc in the units of `Sky`), and the standard deviation of the scatter as a share of the height of the picture."""
NIGHT_GAIN = 12.0
NIGHT_TARGET = 0.08
"""Mean level of pictures at night, which cameras leave dark."""


def at_night(lens: LensProperties) -> LensProperties:
    """The camera in the dark: it exposes longer and amplifies more."""
    return replace(
        lens,
        blur_px=max(lens.blur_px, NIGHT_BLUR_PX),
        read_noise=NIGHT_NOISE * lens.read_noise,
        full_well=NIGHT_FULL_WELL * lens.full_well,
        target=min(lens.target, NIGHT_TARGET),
        gain=(lens.gain[0], max(lens.gain[1], NIGHT_GAIN)),
    )


def against_the_sun(lens: LensProperties) -> LensProperties:
    """The lens with the sun in it, or just outside."""
    return replace(lens, flare=LOW_SUN_FLARE)


def expose(
    linear: Floats,
    seen: NDArray[np.bool_],
    lens: LensProperties,
    rng: np.random.Generator,
    *,
    light: float,
    dirt: Floats | None,
) -> NDArray[np.uint8]:
    """(h, w, 3) uint8 BGR picture of (h, w, 3) radiance.

    Args:
        seen: (h, w), false outside the lens's circle, where the picture is black.
        light: share of the scene's light that is left.
        dirt: (h, w) cover of the lens, 0 clean to 1 opaque.
    """
    light_in = np.minimum(linear, np.float32(4.0)) * np.float32(light)  # the sun's disc blooms, but not over everything
    if lens.flare:
        bright = np.minimum(linear, np.float32(FLARE_LIGHT)) * np.float32(lens.flare * light)
        light_in += np.asarray(cv2.GaussianBlur(bright, (0, 0), FLARE_SPREAD * linear.shape[0]), np.float32)
    if dirt is not None:
        veil = cv2.GaussianBlur(light_in, (0, 0), linear.shape[0] / 25)
        cover = dirt[:, :, None]
        light_in = light_in * (1 - cover) + cover * (0.35 * veil + np.float32(0.05 * light))
    picture = np.asarray(cv2.GaussianBlur(light_in, (0, 0), lens.blur_px), np.float32)
    picture *= _falloff((seen.shape[0], seen.shape[1]), lens.vignetting)[:, :, None]
    level = float(np.minimum(picture[seen], 1.0).mean(dtype=np.float64)) if seen.any() else lens.target
    gain = float(np.clip(lens.target / max(level, 1e-6), *lens.gain))
    picture *= np.float32(gain)
    # A gain amplifies the noise with the light: fewer electrons make full exposure.
    spread = np.sqrt(
        np.maximum(picture, 0) * np.float32(gain / lens.full_well) + np.float32((lens.read_noise * gain) ** 2)
    )
    picture += spread * rng.standard_normal(picture.shape, dtype=np.float32)
    picture[~seen] = 0.0
    return tone(np.maximum(picture, np.float32(0)), 1.0)


def dirt_cover(shape: tuple[int, int], share: float, seed: int) -> Floats:
    """(h, w) cover of the lens by blotches of all sizes, over about this share of the picture."""
    rng = np.random.default_rng([seed, 120])
    cover = np.zeros(shape, np.float32)
    for cells, weight in ((5, 1.0), (11, 0.6), (29, 0.35)):
        noise = rng.standard_normal((cells, cells)).astype(np.float32)
        cover += weight * cv2.resize(noise, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    limit = float(np.quantile(cover, 1 - share)) if share > 0 else np.inf
    return (
        np.clip((cover - limit) * 2.5 + 0.5, 0, 0.97).astype(np.float32) if share > 0 else np.zeros(shape, np.float32)
    )


@lru_cache(maxsize=2)
def _falloff(shape: tuple[int, int], vignetting: float) -> Floats:
    height, width = shape
    y = (np.arange(height) - (height - 1) / 2) / (height / 2)
    x = (np.arange(width) - (width - 1) / 2) / (width / 2)
    squared = np.minimum(y[:, None] ** 2 + x[None, :] ** 2, 1.5)
    return (1 - vignetting * squared).astype(np.float32)
