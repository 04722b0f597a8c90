"""What goes wrong on a road, done to a recorded or simulated window: one mutation each, seeded, pure.

A mutation takes a window and a generator and returns another window. Images come back raw, so that nothing but the
mutation changes them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion, EncodedImage, FramePair, ImageFormat, LidarFrame, Window
from coec.config import LimitsConfig
from coec.io.images import decode_bgr

Pixels = NDArray[np.uint8]
Mutation = Callable[[Window, np.random.Generator], Window]

BAND_RAD = np.radians(0.42)
"""Spacing of the beams of a 64-beam sensor."""

HIDDEN_RAD = np.radians(0.6)
"""A surface hides what is behind it within so much of its points: the spacing of the beams and then some."""

GROUND_M = -1.3
"""Height over the LiDAR, metres, below which a point of a car's LiDAR counts as road."""


# ------------------------------------------------------------------------------------------------ how to mutate
def with_images(window: Window, change: Callable[[Pixels, int], Pixels]) -> Window:
    """`change(pixels, index)` on every image, (h, w, 3) uint8 BGR; a precomputed depth map stays as it is."""

    def changed(pair: FramePair, index: int) -> FramePair:
        pixels = change(decode_bgr(pair.camera.image, LimitsConfig()).copy(), index)
        height, width = pixels.shape[:2]
        image = EncodedImage(ImageFormat.BGR8, width, height, np.ascontiguousarray(pixels).tobytes())
        return replace(pair, camera=replace(pair.camera, image=image))

    return _each(window, changed)


def with_points(window: Window, select: Callable[[LidarFrame, int], NDArray[np.intp]]) -> Window:
    """Only the points of every sweep whose indices `chosen(sweep, index)` returns, in that order."""

    def changed(pair: FramePair, index: int) -> FramePair:
        sweep = pair.lidar
        at = select(sweep, index)
        return replace(
            pair,
            lidar=replace(
                sweep,
                xyz_m=np.ascontiguousarray(sweep.xyz_m[at]),
                intensity=None if sweep.intensity is None else sweep.intensity[at],
                ring=None if sweep.ring is None else sweep.ring[at],
                time_offset_s=None if sweep.time_offset_s is None else sweep.time_offset_s[at],
            ),
        )

    return _each(window, changed)


def with_motion(window: Window, change: Callable[[EgoMotion], EgoMotion | None]) -> Window:
    """`change` on the ego-motion of every pair that has one."""
    return _each(window, lambda pair, _: pair if pair.motion is None else replace(pair, motion=change(pair.motion)))


def _each(window: Window, change: Callable[[FramePair, int], FramePair]) -> Window:
    return replace(window, pairs=tuple(change(pair, index) for index, pair in enumerate(window.pairs)))


# -------------------------------------------------------------------------------------------------- the image
def rain_drops(window: Window, rng: np.random.Generator, drops: int = 40) -> Window:
    """Discs that show the scene upside down and blurred, elsewhere on every image: drops on a wiped lens."""

    def change(pixels: Pixels, index: int) -> Pixels:
        del index
        height, width = pixels.shape[:2]
        behind = _blurred(pixels[::-1], 9.0)
        where = np.zeros((height, width), np.float32)
        for _ in range(drops):
            centre = (int(rng.integers(width)), int(rng.integers(height)))
            cv2.circle(where, centre, int(rng.uniform(0.008, 0.03) * width), 1.0, -1)
        return _blended(pixels, behind.astype(np.uint8), _blurred(where, 2.0))

    return with_images(window, change)


def dirt(window: Window, rng: np.random.Generator, spots: int = 25) -> Window:
    """Dark spots with soft rims that stay where they are."""
    camera = window.rig.camera
    where = np.zeros((camera.height, camera.width), np.float32)
    for _ in range(spots):
        centre = (int(rng.integers(camera.width)), int(rng.integers(camera.height)))
        axes = (int(rng.uniform(0.01, 0.04) * camera.width), int(rng.uniform(0.01, 0.03) * camera.width))
        cv2.ellipse(where, centre, axes, float(rng.uniform(0, 180)), 0, 360, 0.9, -1)
    soft = _blurred(where, 3.0)
    return with_images(window, lambda pixels, _: _blended(pixels, np.full_like(pixels, 35), soft))


def body(window: Window, rng: np.random.Generator) -> Window:
    """A bonnet with a crease at the bottom, and a mirror at the left: the vehicle itself, in view all the time."""
    camera = window.rig.camera
    width, height = camera.width, camera.height
    where = np.zeros((height, width), np.uint8)
    paint = np.zeros((height, width, 3), np.uint8)
    bonnet = ((width // 2, int(1.15 * height)), (int(0.45 * width), int(0.35 * height)))
    cv2.ellipse(where, *bonnet, 0, 0, 360, 1, -1)
    cv2.ellipse(paint, *bonnet, 0, 0, 360, (120, 120, 120), -1)
    cv2.ellipse(paint, (bonnet[0][0], int(1.25 * height)), bonnet[1], 0, 0, 360, (85, 85, 85), -1)
    mirror = ((0, int(0.35 * height)), (int(0.06 * width), int(0.55 * height)))
    cv2.rectangle(where, *mirror, 1, -1)
    cv2.rectangle(paint, *mirror, (40, 40, 40), -1)

    def change(pixels: Pixels, index: int) -> Pixels:
        del index
        noisy = np.clip(paint + rng.normal(0.0, 2.0, paint.shape), 0, 255)
        return np.where(where[..., None] > 0, noisy, pixels).astype(np.uint8)

    return with_images(window, change)


def blown_out_sky(window: Window, rng: np.random.Generator) -> Window:
    """Three stops too bright, with a glow around what is white: the sun in the picture."""
    del rng

    def change(pixels: Pixels, index: int) -> Pixels:
        del index
        bright = np.clip(pixels.astype(np.float32) * 2.5, 0, 255)
        glow = _blurred(np.maximum(bright - 200.0, 0.0), 0.02 * pixels.shape[1])
        return np.asarray(np.clip(bright + 1.5 * glow, 0, 255), np.uint8)

    return with_images(window, change)


def night(window: Window, rng: np.random.Generator, gain: float = 0.06, noise: float = 4.0) -> Window:
    """A sixteenth of the light, and the noise of a sensor at its limit."""

    def change(pixels: Pixels, index: int) -> Pixels:
        del index
        return np.asarray(np.clip(pixels * gain + rng.normal(6.0, noise, pixels.shape), 0, 255), np.uint8)

    return with_images(window, change)


def motion_blur(window: Window, rng: np.random.Generator, length_px: int = 15) -> Window:
    """A long exposure while turning: smeared along the rows."""
    del rng
    kernel = np.full((1, length_px), 1.0 / length_px)
    return with_images(window, lambda pixels, _: np.asarray(cv2.filter2D(pixels, -1, kernel), np.uint8))


def boxes_in_the_image(window: Window, rng: np.random.Generator, boxes: int = 8) -> Window:
    """Striped boxes that no sweep saw: traffic that moved between the exposure and the sweep."""

    def change(pixels: Pixels, index: int) -> Pixels:
        del index
        height, width = pixels.shape[:2]
        for _ in range(boxes):
            w, h = int(rng.uniform(0.03, 0.12) * width), int(rng.uniform(0.1, 0.35) * height)
            x, y = int(rng.integers(width - w)), int(rng.integers(height - h))
            stripes = rng.uniform(20, 235, (1, max(2, w // 12), 3)).astype(np.float32)
            pixels[y : y + h, x : x + w] = cv2.resize(stripes, (w, h), interpolation=cv2.INTER_NEAREST)
        return pixels

    return with_images(window, change)


def covered_lens(window: Window, rng: np.random.Generator) -> Window:
    """Mud over all of it: brightness comes through, no shape does."""
    del rng
    return with_images(window, lambda pixels, _: np.asarray(_blurred(pixels, 0.05 * pixels.shape[1]) * 0.5, np.uint8))


def frozen_camera(window: Window, rng: np.random.Generator) -> Window:
    """The same image over and over, with new stamps."""
    del rng
    first = window.pairs[0].camera
    return _each(
        window, lambda pair, _: replace(pair, camera=replace(pair.camera, image=first.image, depth=first.depth))
    )


# -------------------------------------------------------------------------------------------------- the sweep
def sixteen_beams(window: Window, rng: np.random.Generator) -> Window:
    """Every fourth beam of 64."""
    del rng
    return with_points(window, lambda sweep, _: np.flatnonzero(_band(sweep) % 4 == 0))


def unorganised(window: Window, rng: np.random.Generator) -> Window:
    """Points in any order, and nothing that tells their beams."""
    shuffled = with_points(window, lambda sweep, _: rng.permutation(len(sweep.xyz_m)))
    return _each(shuffled, lambda pair, _: replace(pair, lidar=replace(pair.lidar, ring=None)))


def few_points(window: Window, rng: np.random.Generator, share: int = 32) -> Window:
    """One point in 32, drawn at random."""
    return with_points(
        window,
        lambda sweep, _: np.sort(rng.choice(len(sweep.xyz_m), max(1, len(sweep.xyz_m) // share), replace=False)),
    )


def half_the_azimuths(window: Window, rng: np.random.Generator) -> Window:
    """Nothing to the right of the driving direction: a sensor half covered."""
    del rng
    return with_points(window, lambda sweep, _: np.flatnonzero(sweep.xyz_m[:, 1] > 0.0))


def clusters_moved_in_the_cloud(window: Window, rng: np.random.Generator, clusters: int = 12) -> Window:
    """What stands on the road within 2 m of some points is 2 m further, and hides what is behind it there: traffic, but
    only for the LiDAR."""
    torn = torn_clusters_in_the_cloud(window, rng, clusters)

    def seen(sweep: LidarFrame, index: int) -> NDArray[np.intp]:
        still = (sweep.xyz_m == window.pairs[index].lidar.xyz_m).all(axis=1)
        x, y, z = sweep.xyz_m.astype(np.float64).T
        range_m = np.sqrt(x * x + y * y + z * z)
        rows = np.floor(np.arctan2(z, np.hypot(x, y)) / HIDDEN_RAD).astype(np.int64)
        columns = np.floor(np.arctan2(y, x) / HIDDEN_RAD).astype(np.int64)
        cells = (rows - rows.min()) * 10_000 + (columns - columns.min())
        nearest = np.full(int(cells.max()) + 1, np.inf)
        np.minimum.at(nearest, cells[~still], range_m[~still])
        return np.flatnonzero(range_m <= nearest[cells] + 1.0)

    return with_points(torn, seen)


def torn_clusters_in_the_cloud(window: Window, rng: np.random.Generator, clusters: int = 12) -> Window:
    """The same without hiding anything: scan lines jump to and fro, as behind glass or in a cloud of several echoes."""

    def changed(pair: FramePair, index: int) -> FramePair:
        del index
        xyz_m = pair.lidar.xyz_m.copy()
        standing = np.flatnonzero((xyz_m[:, 2] > GROUND_M) & (xyz_m[:, 0] > 3.0))
        for seed in rng.choice(standing, clusters):
            near = standing[np.linalg.norm(xyz_m[standing, :2] - xyz_m[seed, :2], axis=1) < 2.0]
            heading = rng.uniform(0.0, 2.0 * np.pi)
            xyz_m[near, :2] += np.array([2.0 * np.cos(heading), 2.0 * np.sin(heading)], np.float32)
        return replace(pair, lidar=replace(pair.lidar, xyz_m=xyz_m))

    return _each(window, changed)


def own_body_in_the_cloud(window: Window, rng: np.random.Generator) -> Window:
    """A roof rack, 1.2 m from the sensor and the same in every sweep."""
    azimuth = np.linspace(-0.5, 0.5, 400)
    rack = np.stack([1.2 * np.cos(azimuth), 1.2 * np.sin(azimuth), np.full_like(azimuth, -0.3)], axis=1)

    def changed(pair: FramePair, index: int) -> FramePair:
        del index
        sweep, at = pair.lidar, rng.integers(len(pair.lidar.xyz_m), size=len(rack))
        lidar = replace(
            sweep,
            xyz_m=np.concatenate([sweep.xyz_m, rack.astype(np.float32)]),
            intensity=None if sweep.intensity is None else np.concatenate([sweep.intensity, sweep.intensity[at]]),
            ring=None if sweep.ring is None else np.concatenate([sweep.ring, sweep.ring[at]]),
            time_offset_s=None
            if sweep.time_offset_s is None
            else np.concatenate([sweep.time_offset_s, sweep.time_offset_s[at]]),
        )
        return replace(pair, lidar=lidar)

    return _each(window, changed)


def _band(sweep: LidarFrame) -> NDArray[np.int64]:
    """The beam of every point: its ring, else its band of elevation."""
    if sweep.ring is not None:
        return sweep.ring.astype(np.int64)
    x, y, z = sweep.xyz_m.T
    return np.asarray(np.floor(np.arctan2(z, np.hypot(x, y)) / BAND_RAD), np.int64)


# ------------------------------------------------------------------------------------------------ time and motion
def wrong_ego_motion(window: Window, rng: np.random.Generator) -> Window:
    """Backwards: a sign lost between two coordinate frames."""
    del rng
    return with_motion(window, lambda motion: _moving(motion, -1.0))


def fast_ego_motion(window: Window, rng: np.random.Generator) -> Window:
    """Three times as fast: miles, kilometres or metres mistaken for each other."""
    del rng
    return with_motion(window, lambda motion: _moving(motion, 3.0))


def no_ego_motion(window: Window, rng: np.random.Generator) -> Window:
    """None arrives."""
    del rng
    return with_motion(window, lambda _: None)


def late_camera(window: Window, rng: np.random.Generator, late_ns: int = 40_000_000) -> Window:
    """Exposures are stamped 40 ms late."""
    del rng
    return _each(
        window,
        lambda pair, _: replace(pair, camera=replace(pair.camera, stamp_ns=pair.camera.stamp_ns + late_ns)),
    )


def images_of_other_frames(window: Window, rng: np.random.Generator) -> Window:
    """Every sweep with the image, and the depth, of another frame: a synchronisation that failed altogether."""
    del rng
    cameras = [pair.camera for pair in window.pairs]
    moved = cameras[len(cameras) // 2 :] + cameras[: len(cameras) // 2]
    return _each(
        window,
        lambda pair, index: replace(
            pair, camera=replace(pair.camera, image=moved[index].image, depth=moved[index].depth)
        ),
    )


def _moving(motion: EgoMotion, factor: float) -> EgoMotion:
    assert motion.linear_mps is not None
    x, y, z = motion.linear_mps
    p, q, r = motion.angular_radps
    return replace(
        motion,
        linear_mps=(factor * x, factor * y, factor * z),
        angular_radps=(factor * p, factor * q, factor * r),
    )


def _blurred(values: NDArray[np.generic], sigma_px: float) -> NDArray[np.float32]:
    """A Gaussian over rows and columns; as float32, whatever the type."""
    return np.asarray(cv2.GaussianBlur(values.astype(np.float32), (0, 0), sigma_px), np.float32)


def _blended(below: Pixels, above: Pixels, opacity: NDArray[np.float32]) -> Pixels:
    share = opacity[..., None]
    return np.asarray(below * (1.0 - share) + above * share, np.float32).round().astype(np.uint8)


DEGRADATIONS: Mapping[str, Mutation] = MappingProxyType(
    {
        mutation.__name__: mutation
        for mutation in (
            rain_drops,
            dirt,
            body,
            blown_out_sky,
            night,
            motion_blur,
            boxes_in_the_image,
            covered_lens,
            frozen_camera,
            sixteen_beams,
            unorganised,
            few_points,
            half_the_azimuths,
            clusters_moved_in_the_cloud,
            torn_clusters_in_the_cloud,
            own_body_in_the_cloud,
            wrong_ego_motion,
            fast_ego_motion,
            no_ego_motion,
            late_camera,
            images_of_other_frames,
        )
    }
)
"""By name. None moves the camera against the LiDAR: the truth stays what it was."""
