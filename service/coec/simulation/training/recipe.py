"""What the network learns from: streets seen by random cameras, on random mounts, in random light, with exact range.

Everything in a frame that may differ on a real vehicle is drawn anew, so that the network learns what all have in
common (domain randomisation: Tobin et al., IROS 2017).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.cameras import Camera, build
from coec.geometry.se3 import rotation_exp
from coec.simulation.exposure import LensProperties, dirt_cover, expose
from coec.simulation.mesh import Floats
from coec.simulation.render import pixel_rays, render_radiance
from coec.simulation.scene import Scene, Solid
from coec.simulation.sky import sample_sky
from coec.simulation.training.places import TrainingScene, training_scenes
from coec.simulation.training.shown import KINDS, NEAREST_M, SHAPES, SKY, UNKNOWN, TrainingFrame
from coec.simulation.vehicle import P_EGO_CAMERA_M, body

Doubles = NDArray[np.float64]

FRAMES_PER_PLACE = 4
"""More than one, because laying out a place takes longer than rendering a frame."""
TOO_NEAR_M, TOO_NEAR_SHARE = 1.8, 0.3
"""A frame with more than this share of its pixels nearer than `TOO_NEAR_M` looks into a wall and is drawn again."""
HEIGHT_M = (0.8, 2.2)
TILT_RAD = np.deg2rad(8.0)
"""Greatest pitch and roll of a mount."""
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from camera axes (right, down, forward) to a vehicle's (forward, left, up)."""


@dataclass(frozen=True, slots=True)
class Eye:
    """A camera and the half angle of its circle, radians (π: no circle)."""

    camera: Camera
    half_view_rad: float


def frames(seed: int) -> Iterator[TrainingFrame]:
    """The frames of the places of a seed, `FRAMES_PER_PLACE` of each."""
    own = Solid(body())
    for place, rng in training_scenes(seed):
        for _ in range(FRAMES_PER_PLACE):
            yield _frame(place, own, rng)


def sample_camera(kind: str, rng: np.random.Generator) -> Eye:
    """A random camera of a kind."""
    height, width = SHAPES[kind]
    cx, cy = (width - 1) / 2 + rng.normal(0, 0.015) * width, (height - 1) / 2 + rng.normal(0, 0.03) * height
    size = {"width": width, "height": height, "cx": cx, "cy": cy}
    if kind == "round" or (kind == "wide" and rng.random() < 0.35):
        half = np.deg2rad(rng.uniform(70, 95) if kind == "round" else rng.uniform(45, 75))
        xi, alpha = rng.uniform(-0.3, 0.2), rng.uniform(0.52, 0.68)
        z = xi + np.cos(half)
        # Usenko, Demmel, Cremers 2018, equations (40) to (42), at the rim.
        rim = np.sin(half) / (alpha * np.hypot(np.sin(half), z) + (1 - alpha) * z)
        focal = (width - 1) / 2 / rim * (rng.uniform(0.95, 1.35) if kind == "round" else 1.0)
        circle = float(half) if kind == "round" and rng.random() < 0.7 else np.pi
        return Eye(build("double_sphere", fx=focal, fy=focal, xi=xi, alpha=alpha, **size), circle)
    half = np.deg2rad(rng.uniform(38, 56) if kind == "panorama" else rng.uniform(24, 50))
    focal = width / 2 / np.tan(half)
    return Eye(build("pinhole", fx=focal, fy=focal, **size), np.pi)


def sample_lens(rng: np.random.Generator) -> LensProperties:
    """Random properties of a lens, from a clean picture to a poor one."""
    return LensProperties(
        blur_px=float(rng.uniform(0.25, 1.1)),
        vignetting=float(rng.uniform(0.0, 0.45)),
        full_well=float(10 ** rng.uniform(2.7, 4.2)),
        read_noise=float(10 ** rng.uniform(-3, -1.8)),
        target=float(np.clip(rng.normal(0.25, 0.1), 0.08, 0.6)),
        jpeg_quality=int(rng.integers(40, 96)),
    )


def _frame(place: TrainingScene, own: Solid, rng: np.random.Generator) -> TrainingFrame:
    while True:
        kind = str(rng.choice([name for name, _ in KINDS], p=[share for _, share in KINDS]))
        eye = sample_camera(kind, rng)
        with_body = rng.random() < 0.3
        spot_m = place.sample_spot(rng)
        T_ego_camera = _mount(with_body, rng)
        pose = np.einsum("ij,jk->ik", place.stand(spot_m, rng), T_ego_camera)
        scene = place.sample_scene(rng)
        _repaint(scene, rng)
        radiance = render_radiance(scene, eye.camera, pose, half_view_rad=eye.half_view_rad, smooth_edges=False)
        near = float(np.mean(radiance.range_m < TOO_NEAR_M))
        pixel_rays.cache_clear()
        if near > TOO_NEAR_SHARE:
            continue
        seen, hidden = _seen(eye, own if with_body else None, T_ego_camera)
        paint = np.array(scene.sky.horizon, np.float32) * np.exp(rng.uniform(-4, -0.5, 3)).astype(np.float32)
        radiance.linear[hidden] = paint
        return TrainingFrame(kind, _photograph(radiance.linear, seen, rng), _code(radiance.range_m, seen & ~hidden))


def _mount(with_body: bool, rng: np.random.Generator) -> Matrix4:
    """Random T_ego_camera: on the roof behind the bonnet, or anywhere from which no body is seen."""
    if with_body:
        yaw = rng.normal(0, 0.08)
        place = P_EGO_CAMERA_M + np.array([rng.uniform(-0.2, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(-0.1, 0.3)])
    else:
        yaw = rng.normal(0, 0.12) if rng.random() < 0.55 else rng.uniform(-np.pi, np.pi)
        place = np.array([0.0, 0.0, rng.uniform(*HEIGHT_M)])
    tilt = np.clip(rng.normal(0, TILT_RAD / 2, 2), -TILT_RAD, TILT_RAD)
    mount = np.eye(4)
    turned = np.einsum("ij,jk->ik", rotation_exp(np.array([0.0, 0.0, yaw])), AHEAD)
    mount[:3, :3] = np.einsum("ij,jk->ik", turned, rotation_exp(np.array([tilt[0], 0.0, tilt[1]])))
    mount[:3, 3] = place
    return mount


def _repaint(scene: Scene, rng: np.random.Generator) -> None:
    """Gives a scene new weather and colours; colours change from those of the frame before if the scene is the same."""
    scene.sky = sample_sky(int(rng.integers(2**31)))
    colour = scene.colour
    if rng.random() < 0.5:  # all surfaces alike: lighter, darker, another tint
        colour = colour ** np.float32(rng.uniform(0.5, 1.6)) * np.exp(rng.normal(0, 0.2, 3)).astype(np.float32)
    if rng.random() < 0.2:  # patches
        patches = np.exp(rng.normal(0, rng.uniform(0.1, 0.6), (len(colour), 1)))
        colour = colour * patches.astype(np.float32)
    scene.colour = np.clip(colour, 0, 1).astype(np.float32)


def _seen(eye: Eye, own: Solid | None, T_ego_camera: Matrix4) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(h, w) each: what the lens lets through, and what shows the vehicle's own body."""
    rays = pixel_rays(eye.camera, eye.half_view_rad)
    shape = (eye.camera.height, eye.camera.width)
    seen, hidden = np.zeros((2, shape[0] * shape[1]), bool)
    seen[rays.pixel] = True
    if own is not None:
        directions = np.einsum("ij,nj->ni", T_ego_camera[:3, :3], rays.directions).astype(np.float32)
        origins = np.empty_like(directions)
        origins[:] = T_ego_camera[:3, 3]
        hidden[rays.pixel] = own.blocked(origins, directions)
    return seen.reshape(shape), hidden.reshape(shape)


def _photograph(linear: Floats, seen: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.uint8]:
    lens = sample_lens(rng)
    dirt = None
    if rng.random() < 0.1:
        dirt = dirt_cover((seen.shape[0], seen.shape[1]), float(rng.uniform(0.02, 0.15)), int(rng.integers(2**31)))
    light = float(10 ** rng.uniform(-1.0, 0.5))
    bgr = expose(linear, seen, lens, rng, light=light, dirt=dirt)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, lens.jpeg_quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _code(range_m: Floats, known: NDArray[np.bool_]) -> NDArray[np.uint16]:
    code = np.clip(65535 * NEAREST_M / range_m, SKY + 1, 65535)
    code[np.isnan(range_m)] = SKY
    code[~known] = UNKNOWN
    return np.asarray(code, np.uint16)
