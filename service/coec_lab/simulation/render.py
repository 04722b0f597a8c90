"""Pictures by ray casting: light at the lens, row by row for a rolling shutter, and its exposure to pixels with blur,
vignetting, noise and dirt.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.cameras import Camera
from coec.geometry.compiler import PRANGE, njit, prange
from coec.geometry.projection import unproject
from coec_lab.simulation.mesh import Floats
from coec_lab.simulation.scene import Hits, Scene
from coec_lab.simulation.shading import shade

Doubles = NDArray[np.float64]

SHADOW_LIFT_M = 0.02
"""Rays to the sun start this far off a surface, so that it does not shade itself."""
EDGE_SAMPLES: tuple[tuple[float, float], ...] = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))
"""Additional samples (u, v) of a pixel on an edge, pixels: the rotated grid of four."""
EDGE_RANGE = 0.06
"""Neighbours whose ranges differ by more than this share are on an edge."""
GAMMA = 1 / 2.2


class PixelRays(NamedTuple):
    """Rays of the pixels of a camera that see something.

    Attributes:
        pixel: (P,) flat pixel index, ascending.
        directions: (P, 3) float32 unit, camera frame.
        pixel_rad: mean angle between neighbouring pixels.
    """

    pixel: NDArray[np.int64]
    directions: Floats
    pixel_rad: float


class Radiance(NamedTuple):
    """Light at the lens, before exposure.

    Attributes:
        linear: (height, width, 3) float32 BGR; black where the camera sees nothing.
        range_m: (height, width) float32, Euclidean distance from the camera to what the middle of each pixel shows;
            NaN for the sky and where the camera sees nothing.
    """

    linear: Floats
    range_m: Floats


@lru_cache(maxsize=4)
def pixel_rays(camera: Camera, half_view_rad: float = np.pi) -> PixelRays:
    """Rays of the pixels with a valid unprojection, at most `half_view_rad` off the optical axis."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays, valid = unproject(camera, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    index = np.flatnonzero(valid & (rays[:, 2] >= np.cos(half_view_rad)))
    pixel_rad = float(1.0 / np.sqrt(camera.fx * camera.fy))
    return PixelRays(index, np.ascontiguousarray(rays[index], np.float32), pixel_rad)


def tone(linear: Floats, exposure: float) -> NDArray[np.uint8]:
    """8-bit values: exposure, soft shoulder, gamma."""
    return np.asarray(_tone(linear.reshape(-1), float(exposure))).reshape(linear.shape)


class Exposure(NamedTuple):
    """Rows `first` to `last` (excluded) of a picture, taken from `T_world_camera` (4, 4) at `time_s`."""

    first: int
    last: int
    T_world_camera: Matrix4
    time_s: float


def render_radiance(
    scene: Scene,
    camera: Camera,
    T_world_camera: Matrix4,
    *,
    time_s: float = 0.0,
    half_view_rad: float = np.pi,
    smooth_edges: bool = True,
) -> Radiance:
    """What a perfect lens sees: no noise, no blur, no vignetting.

    Args:
        T_world_camera: (4, 4) maps camera coordinates (x right, y down, z forward) to the world (z up).
        time_s: instant that decides where the moving cars are.
        half_view_rad: pixels further off the axis stay black (the lens's circle).
        smooth_edges: whether to cast more rays where neighbouring pixels differ.
    """
    whole = Exposure(0, camera.height, T_world_camera, time_s)
    return render_rows(scene, camera, [whole], half_view_rad=half_view_rad, smooth_edges=smooth_edges)


def render_rows(
    scene: Scene,
    camera: Camera,
    exposures: Sequence[Exposure],
    *,
    half_view_rad: float = np.pi,
    smooth_edges: bool = True,
) -> Radiance:
    """A picture whose rows are taken one after the other, as by a rolling shutter: each part is seen from where the
    camera is at the part's own time. `exposures` must cover each row once."""
    rays = pixel_rays(camera, half_view_rad)
    size, shape = camera.height * camera.width, (camera.height, camera.width)
    linear = np.zeros((size, 3), np.float32)
    range_m = np.full(size, np.nan, np.float32)
    for part in exposures:
        selected = _rows(rays.pixel, part, camera)
        rotation, origin = _placed(part)
        directions = _rotated(rays.directions[selected], rotation)
        hits = scene.cast(origin, directions, part.time_s)
        linear[rays.pixel[selected]] = _lit(scene, origin, directions, hits, part.time_s, rays.pixel_rad)
        range_m[rays.pixel[selected]] = np.where(hits.triangle < 0, np.float32(np.nan), hits.range_m)
    if smooth_edges:
        seen = np.zeros(size, bool)
        seen[rays.pixel] = True
        edge = np.flatnonzero(_edges(linear.reshape(*shape, 3), range_m.reshape(shape), seen.reshape(shape)).ravel())
        for part in exposures:
            pixels = edge[_rows(edge, part, camera)]
            rotation, origin = _placed(part)
            linear[pixels] = _supersampled(
                scene, camera, rotation, origin, pixels, linear[pixels], part.time_s, rays.pixel_rad
            )
    return Radiance(linear.reshape(*shape, 3), range_m.reshape(shape))


def _rows(pixels: NDArray[np.int64], part: Exposure, camera: Camera) -> slice:
    """Slice of the ascending `pixels` that lie in the rows of a part."""
    first, last = np.searchsorted(pixels, (part.first * camera.width, part.last * camera.width))
    return slice(int(first), int(last))


def _placed(part: Exposure) -> tuple[Doubles, Doubles]:
    """Rotation (3, 3) and origin (3,) of a part, as the compiled code takes them."""
    return np.ascontiguousarray(part.T_world_camera[:3, :3], np.float64), np.asarray(part.T_world_camera[:3, 3])


def _lit(scene: Scene, origin: Doubles, directions: Floats, hits: Hits, time_s: float, pixel_rad: float) -> Floats:
    shadowed = np.zeros(len(directions), np.float32)
    if any(scene.sky.sun):
        facing = _facing_sun(hits.triangle, hits.normal, scene.sky.towards_sun)
        points = _points(hits, directions, (origin - scene.origin_m).astype(np.float32), facing)
        shadowed[facing] = scene.shadowed(points, time_s)
    return shade(scene, origin, directions, hits, shadowed, pixel_rad)


def _supersampled(
    scene: Scene, camera: Camera, rotation: Doubles, origin: Doubles, pixels: NDArray[np.int64], first: Floats,
    time_s: float, pixel_rad: float,
) -> Floats:  # fmt: skip
    """Mean radiance of the pixels over the middle and `EDGE_SAMPLES`; bright light is cut off as by a sensor."""
    v, u = np.divmod(pixels, camera.width)
    total: Floats = np.minimum(first, np.float32(1.5))
    count = np.ones((len(pixels), 1), np.float32)
    for du, dv in EDGE_SAMPLES:
        rays, valid = unproject(camera, np.column_stack([u + du, v + dv]))
        directions = _rotated(rays.astype(np.float32), rotation)
        hits = scene.cast(origin, directions, time_s)
        light = _lit(scene, origin, directions, hits, time_s, 0.5 * pixel_rad)
        total += np.where(valid[:, None], np.minimum(light, np.float32(1.5)), np.float32(0))
        count += valid[:, None]
    return np.asarray(total / count, np.float32)


def _facing_sun(triangle: NDArray[np.int32], normal: Floats, sun: Floats) -> NDArray[np.int64]:
    # Without BLAS, so that the bits do not depend on its threads.
    cosine = normal[:, 0] * sun[0] + normal[:, 1] * sun[1] + normal[:, 2] * sun[2]
    return np.flatnonzero((triangle >= 0) & (cosine > 0))


def _points(hits: Hits, directions: Floats, origin: Floats, selected: NDArray[np.int64]) -> Floats:
    return np.asarray(
        origin
        + directions[selected] * hits.range_m[selected, None]
        + hits.normal[selected] * np.float32(SHADOW_LIFT_M)
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _rotated(vectors: Floats, rotation: Doubles) -> Floats:
    out = np.empty_like(vectors)
    for i in range(len(vectors)):
        x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
        for r in range(3):
            out[i, r] = rotation[r, 0] * x + rotation[r, 1] * y + rotation[r, 2] * z
    return out


@njit(cache=True, parallel=PRANGE)
def _tone(linear: Floats, exposure: float) -> NDArray[np.uint8]:
    out = np.empty(len(linear), np.uint8)
    for i in prange(len(linear)):
        value = exposure * linear[i]
        if value > 0.7:  # a shoulder instead of a hard cut
            value = 0.7 + 0.3 * (1.0 - np.exp((0.7 - value) / 0.3))
        out[i] = np.uint8(255.0 * max(value, 0.0) ** GAMMA + 0.5)
    return out


@njit(cache=True, nogil=True)
def _edges(linear: Floats, range_m: Floats, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w): pixels that differ in range or brightness from a neighbour."""
    h, w = range_m.shape
    out = np.zeros((h, w), np.bool_)
    for y in range(h):
        for x in range(w):
            if not seen[y, x]:
                continue
            for k in range(2):
                y2, x2 = y + k, x + 1 - k
                if y2 >= h or x2 >= w or not seen[y2, x2]:
                    continue
                a, b = range_m[y, x], range_m[y2, x2]
                gone_a, gone_b = a != a, b != b
                differs = gone_a != gone_b or (not gone_a and abs(a - b) > EDGE_RANGE * min(a, b))
                if not differs:
                    low, high = min(linear[y, x, 1], 1.5), min(linear[y2, x2, 1], 1.5)
                    differs = abs(low - high) > 0.15 * (low + high) + 0.01
                if differs:
                    out[y, x] = True
                    out[y2, x2] = True
    return out


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
