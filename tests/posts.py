"""Dark posts before a bright wall: a picture and a sweep that tell the same extrinsic, for any camera."""

from __future__ import annotations

from collections.abc import Sequence
from math import radians

import numpy as np

from coec.adapters.images.codec import encode_png
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Matrix4, Rig, Window
from coec.geometry.cameras import Camera, build
from coec.geometry.edges.range_edges import SPILL_RAD
from coec.geometry.projection import unproject

POST_T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Both in one place: what they see is a matter of directions alone."""

POST_CAMERA = build("pinhole", width=640, height=360, fx=400.0, fy=400.0, cx=319.5, cy=179.5)

POST_STAMP_NS = 1_600_000_000_123_000_000
"""2020-09-13T12:26:40.123Z."""

POST_M, POST_WALL_M, HALF_POST_RAD, HALF_HEIGHT_RAD = 8.0, 25.0, radians(1.2), radians(9.0)
LINES_RAD, COLUMN_RAD = radians(0.4), radians(0.1)


def post_window(
    posts_deg: Sequence[float] = (0.0,),
    camera: Camera = POST_CAMERA,
    T_camera_lidar: Matrix4 = POST_T_CAMERA_LIDAR,
    stamp_ns: int = POST_STAMP_NS,
    mask: np.ndarray | None = None,
) -> Window:
    """One pair, with posts at these azimuths (left is positive), and where the window begins: the true extrinsic."""
    rig = Rig("front", camera, "camera", "lidar", T_camera_lidar, np.eye(4), mask)
    image = EncodedImage(ImageFormat.PNG, camera.width, camera.height, encode_png(_post_image(camera, posts_deg)))
    pair = FramePair(CameraFrame(stamp_ns, "camera", image), _post_sweep(posts_deg, stamp_ns))
    return Window("front-1", rig, T_camera_lidar, (pair,))


def _is_post(
    azimuth: np.ndarray, elevation: np.ndarray, posts_deg: Sequence[float], spill_rad: float = 0.0
) -> np.ndarray:
    offset_rad = np.min([np.abs(azimuth - radians(post)) for post in (*posts_deg, 1e3)], axis=0)
    return np.asarray((offset_rad < HALF_POST_RAD + spill_rad) & (np.abs(elevation) < HALF_HEIGHT_RAD))


def _post_image(camera: Camera, posts_deg: Sequence[float]) -> np.ndarray:
    v, u = np.mgrid[: camera.height, : camera.width]
    rays, valid = unproject(camera, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    x, y, z = (rays @ POST_T_CAMERA_LIDAR[:3, :3]).T
    post = _is_post(np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0)), posts_deg)
    noise = np.random.default_rng(1).normal(0.0, 2.0, len(rays))
    grey = np.where(valid, np.where(post, 40.0, 180.0) + noise, 0.0)
    return np.repeat(grey.astype(np.uint8).reshape(camera.height, camera.width, 1), 3, axis=2)


def _post_sweep(posts_deg: Sequence[float], stamp_ns: int) -> LidarFrame:
    elevation, azimuth = np.meshgrid(np.arange(-30, 31) * LINES_RAD, np.arange(-900, 900) * COLUMN_RAD, indexing="ij")
    ring = np.repeat(np.arange(len(elevation)), elevation.shape[1]).astype(np.uint16)
    azimuth, elevation = azimuth.ravel(), elevation.ravel()
    range_m = np.where(_is_post(azimuth, elevation, posts_deg, SPILL_RAD), POST_M, POST_WALL_M)
    direction = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    return LidarFrame(stamp_ns, "lidar", (range_m[:, None] * direction).astype(np.float32), ring=ring)


POST_IMAGE_SIZE = {"width": 640, "height": 360, "cx": 319.5, "cy": 179.5}

POST_LENSES: dict[str, Camera] = {
    "pinhole": POST_CAMERA,
    "radtan": build("radtan", **POST_IMAGE_SIZE, fx=400.0, fy=401.0, k1=-0.1, k2=0.02, p1=1e-3, p2=-1e-3, k3=-1e-3),
    "rational": build(
        "rational",
        **POST_IMAGE_SIZE,
        fx=400.0,
        fy=401.0,
        k1=0.1,
        k2=0.01,
        p1=1e-3,
        p2=-1e-3,
        k3=1e-3,
        k4=0.15,
        k5=0.02,
        k6=1e-3,
    ),
    "kannala_brandt": build(
        "kannala_brandt", **POST_IMAGE_SIZE, fx=200.0, fy=201.0, k1=-0.05, k2=0.01, k3=-0.004, k4=5e-4
    ),
    "mei": build("mei", **POST_IMAGE_SIZE, fx=400.0, fy=401.0, xi=1.5, k1=0.01, k2=0.05, p1=1e-3, p2=1e-3),
    "eucm": build("eucm", **POST_IMAGE_SIZE, fx=200.0, fy=201.0, alpha=0.6, beta=1.1),
    "double_sphere": build("double_sphere", **POST_IMAGE_SIZE, fx=180.0, fy=181.0, xi=-0.2, alpha=0.6),
}
