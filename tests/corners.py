"""A drive past corners that range edges and image edges both show, without a picture being drawn."""

from __future__ import annotations

import numpy as np

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, FramePair, ImageFormat, LidarFrame, Rig, Window
from coec.geometry.cameras import Camera, build, scaled
from coec.geometry.edges.alignment import EdgeFrames
from coec.geometry.projection import project
from landscapes import Array

CORNER_FRAMES, CORNERS_PER_FRAME = 8, 400
CORNER_CAMERA = build("pinhole", width=480, height=320, fx=240.0, fy=240.0, cx=239.5, cy=159.5)
CORNER_RIG = Rig("front", CORNER_CAMERA, "camera", "lidar", np.eye(4), np.eye(4))
CORNER_LEVELS = (2, 1, 0)
"""Halvings of the image, from the coarsest level to the sharpest."""
IDENTITY_POSE = np.eye(4)
FORWARD_MPS = (0.0, 0.0, 8.0)
"""The frame of the LiDAR is the camera's, and so is the vehicle's."""


def corner_motions(speed: float = 1.0) -> list[EgoMotion]:
    """Of a drive whose pace and heading change from pair to pair."""
    along, swing = speed * np.array(FORWARD_MPS), speed * np.linspace(-0.2, 0.2, CORNER_FRAMES) ** 2
    return [
        EgoMotion(
            frame * 10**9, "ego", tuple((along * (1.0 + 0.3 * np.sin(frame))).tolist()), (0.0, float(swing[frame]), 0.0)
        )
        for frame in range(CORNER_FRAMES)
    ]


def corner_window(of: list[EgoMotion]) -> Window:
    image = EncodedImage(ImageFormat.MONO8, CORNER_CAMERA.width, CORNER_CAMERA.height, b"")
    sweep = LidarFrame(0, "lidar", np.zeros((0, 3), np.float32))
    pairs = tuple(FramePair(CameraFrame(m.stamp_ns, "camera", image), sweep, m) for m in of)
    return Window("w", CORNER_RIG, IDENTITY_POSE, pairs)


def corner_points(rng: np.random.Generator) -> list[Array]:
    """Of each frame (N, 3): corners in view, 3 to 30 m away."""
    frames_m = []
    for _ in range(CORNER_FRAMES):
        u, v = (
            rng.uniform(10, CORNER_CAMERA.width - 10, CORNERS_PER_FRAME),
            rng.uniform(10, CORNER_CAMERA.height - 10, CORNERS_PER_FRAME),
        )
        away = rng.uniform(3.0, 30.0, CORNERS_PER_FRAME)
        rays = np.column_stack(
            [
                (u - CORNER_CAMERA.cx) / CORNER_CAMERA.fx,
                (v - CORNER_CAMERA.cy) / CORNER_CAMERA.fy,
                np.ones(CORNERS_PER_FRAME),
            ]
        )
        frames_m.append(away[:, None] * rays)
    return frames_m


def corner_edge_levels(seen_px: list[Array], measured_m: list[Array]) -> list[EdgeFrames]:
    """Images with a blob at the pixels (N, 2) of each frame, and as range edges what was measured there (N, 3)."""
    xyz_m = np.concatenate(measured_m).T.astype(np.float32)
    first = np.cumsum([0, *(len(points) for points in measured_m)]).astype(np.int64)
    pyramid = []
    for halvings in CORNER_LEVELS:
        camera = scaled(CORNER_CAMERA, 0.5**halvings, 0.5**halvings)
        blur_px = 1.0 if halvings == 0 else 2.0
        kernel = np.exp(-0.5 * (np.arange(-6, 7) / blur_px) ** 2)
        maps = np.zeros((CORNER_FRAMES, camera.height, camera.width))
        for image, uv in zip(maps, seen_px, strict=True):
            column, row = np.round((uv + 0.5) * 0.5**halvings - 0.5).astype(int).T
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            image[row[inside], column[inside]] = 1.0
            for axis in (0, 1):
                image[:] = np.apply_along_axis(np.convolve, axis, image, kernel, mode="same")
        steps = np.clip(16.0 * (maps - maps.mean()) / maps.std(), -127, 127).astype(np.int8)
        pyramid.append(EdgeFrames(camera, xyz_m, np.ones(xyz_m.shape[1], np.float32), first, steps))
    return pyramid


def corner_pixels(points_m: list[Array], camera: Camera = CORNER_CAMERA) -> list[Array]:
    return [project(camera, points)[0] for points in points_m]
