"""Scenes that nobody rendered: posts before a wall, a board before a wall, rings of a turning LiDAR, a drive past
corners, and objectives whose optimum scatters by a known law. Where an edge or an optimum lies is known exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.landscape import Landscape
from coec.calibration.objective.mutual_information import Cells, PointsInView
from coec.calibration.types import (
    CameraFrame,
    EgoMotion,
    EncodedImage,
    FramePair,
    ImageFormat,
    LidarFrame,
    Matrix4,
    Rig,
    Window,
)
from coec.geometry import se3
from coec.geometry.cameras import Camera, build, scaled
from coec.geometry.edges.alignment import EdgeFrames
from coec.geometry.edges.range_edges import SPILL_RAD
from coec.geometry.projection import project, unproject
from coec.io.images import encode_jpeg, encode_png

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


BOARD_WALL_M, BOARD_M = 20.0, 6.0
HALF_WIDTH_M = 1.0
"""Of the board, which stands straight ahead and is higher than the sweep."""

BOARD_COLUMNS, BOARD_RINGS = 1800, 32

BOARD_NOMINAL = np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.3], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 0.0, 1.0]])
BOARD_MOVED = se3.perturb(BOARD_NOMINAL, np.radians([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
BOARD_IMAGE_SIZE = {"width": 640, "height": 400}

BOARD_LENSES: dict[str, Camera] = {
    "pinhole": build("pinhole", **BOARD_IMAGE_SIZE, fx=320.0, fy=321.0, cx=319.5, cy=199.5),
    "radtan": build(
        "radtan",
        **BOARD_IMAGE_SIZE,
        fx=320.0,
        fy=321.0,
        cx=319.5,
        cy=199.5,
        k1=-0.1,
        k2=0.02,
        p1=1e-3,
        p2=-1e-3,
        k3=-1e-3,
    ),
    "kannala_brandt": build(
        "kannala_brandt",
        **BOARD_IMAGE_SIZE,
        fx=300.0,
        fy=301.0,
        cx=320.5,
        cy=200.5,
        k1=-0.05,
        k2=0.01,
        k3=-0.004,
        k4=5e-4,
    ),
    "double_sphere": build(
        "double_sphere", **BOARD_IMAGE_SIZE, fx=180.0, fy=181.0, cx=320.5, cy=200.5, xi=-0.2, alpha=0.6
    ),
}


def board_rig(camera: Camera, mask: NDArray[np.bool_] | None = None) -> Rig:
    return Rig("front", camera, "cam", "velo", BOARD_NOMINAL, np.eye(4), mask)


def board_sweep() -> LidarFrame:
    """The forward third of a turn, in rows."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi / 3, np.pi / 3, BOARD_COLUMNS), np.radians(np.linspace(-10.0, 10.0, BOARD_RINGS))
    )
    slope = np.tan(azimuth)
    ahead_m = np.where(np.abs(BOARD_M * slope) <= HALF_WIDTH_M, BOARD_M, BOARD_WALL_M)
    side_m = ahead_m * slope
    up_m = np.hypot(ahead_m, side_m) * np.tan(elevation)
    xyz_m = np.stack([ahead_m, side_m, up_m], axis=-1).reshape(-1, 3).astype(np.float32)
    return LidarFrame(10**18, "velo", xyz_m, ring=np.repeat(np.arange(BOARD_RINGS), BOARD_COLUMNS).astype(np.uint16))


def board_frame_pair(camera: Camera, stamp_ns: int = 10**18) -> FramePair:
    """With a grey picture."""
    grey = np.full((camera.height, camera.width, 3), 90, np.uint8)
    image = EncodedImage(ImageFormat.JPEG, camera.width, camera.height, encode_jpeg(grey))
    return FramePair(CameraFrame(stamp_ns, "cam", image), board_sweep())


ELEVATIONS_DEG = np.linspace(-15.0, 15.0, 16)
ROOF_POSE = se3.exp(np.array([0.0, 0.0, 0.4, 1.4, 0.3, 2.1]))
TILTED_ROOF_POSE = se3.exp(np.array([0.1, 0.15, 0.4, 1.4, 0.3, 2.1]))


def turning_sweep(seed: int = 1, noise_rad: float = 0.0, walkers: float = 0.0) -> LidarFrame:
    """A turning LiDAR of 16 beams, 1.8 m above the ground, among walls 3 to 30 m away. `walkers`: share of the points
    whose elevation is anything."""
    rng = np.random.default_rng(seed)
    azimuth, ring = np.repeat(np.linspace(-np.pi, np.pi, 400, endpoint=False), 16), np.tile(np.arange(16), 400)
    elevation = np.radians(ELEVATIONS_DEG)[ring] + rng.normal(0.0, noise_rad, ring.size)
    strays = rng.random(ring.size) < walkers
    elevation = np.where(strays, rng.uniform(-0.3, 0.3, ring.size), elevation)
    wall_m = 3.0 + 27.0 * (0.5 + 0.5 * np.sin(5 * azimuth + rng.uniform(0, 6)))
    ground_m = np.where(elevation < -0.01, 1.8 / np.maximum(np.sin(-elevation), 0.01), np.inf)
    range_m = np.minimum(wall_m / np.cos(elevation), ground_m)
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    return LidarFrame(5, "lidar", (range_m[:, None] * direction).astype(np.float32), ring=ring.astype(np.uint16))


def sweep_in_frame(sweep: LidarFrame, T_frame_lidar: NDArray[np.float64]) -> LidarFrame:
    """The same points, given in another frame, as a driver would."""
    xyz_m = sweep.xyz_m.astype(np.float64) @ T_frame_lidar[:3, :3].T + T_frame_lidar[:3, 3]
    return replace(sweep, frame_id="base_link", xyz_m=xyz_m.astype(np.float32))


Array = NDArray[np.float64]

NO_WINDOW_DATA_LINES = PointsInView(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))


def landscape(score: Callable[[Array], Array], axes: int = 3, step_rad: float = 1e-3) -> Landscape:
    """Of cells (F, B) as a function of the perturbation (6,), about no perturbation."""
    return Landscape.about(
        Cells(
            lambda poses: np.array([score(se3.perturbation_log(pose)) for pose in poses]),
            step_rad,
            NO_WINDOW_DATA_LINES,
        ),
        np.eye(4),
        tuple(range(axes)),
    )


def paraboloids(square: Array, maxima: Array) -> Callable[[Array], Array]:
    """A quadratic score (n, n) in each cell, with a maximum (F, B, n) of its own."""
    n = maxima.shape[-1]

    def score(xi: Array) -> Array:
        away = xi[:n] - maxima
        return np.asarray(-0.5 * np.einsum("fbi,ij,fbj->fb", away, square, away))

    return score


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
        maps = np.zeros((len(seen_px), camera.height, camera.width))
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
