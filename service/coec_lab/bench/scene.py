"""The scene of the speed table: a spinning LiDAR and a camera at one point of a room whose walls lie at a known range
in every direction, so that the depth map of any camera is exact and the true pose is a maximum.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coec.calibration.objective.mutual_information import (
    Features,
    MutualInformation,
    SearchBox,
    build_mutual_information,
)
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Matrix4, Rig
from coec.config import ObjectiveConfig
from coec.geometry.cameras import Camera, build, name_of, scaled
from coec.geometry.mutual_information import BinnedFrames
from coec.geometry.projection import unproject
from coec.io.images import encode_jpeg

POINTS, BEAMS = 114_000, 64
"""Usual number of points, and beams, of a sweep, as of the LiDAR of KITTI and KITTI-360."""

IMAGE_PX, MAP_PX = 1400, 512
"""Side of the image (KITTI-360's fisheye), and of a depth map as a network returns it."""

LOWEST_RAD, HIGHEST_RAD = np.deg2rad([-24.8, 2.0])
"""Elevations of that LiDAR's beams."""

T_TRUE: Matrix4 = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""The camera looks ahead: its axes are x right, y down, z forward, those of the LiDAR x forward, y left, z up."""

_SENSOR = {"width": IMAGE_PX, "height": IMAGE_PX, "cx": 699.5, "cy": 699.5, "fx": 437.5, "fy": 437.5}
CAMERAS: dict[str, Camera] = {
    "double_sphere": build("double_sphere", **_SENSOR, xi=-0.2, alpha=0.6),
    "pinhole": build("pinhole", **_SENSOR),
    "radtan": build("radtan", **_SENSOR, k1=-0.3, k2=0.1, p1=1e-4, p2=1e-4, k3=0.0),
    "kannala_brandt": build("kannala_brandt", **_SENSOR, k1=-0.01, k2=0.01, k3=-0.01, k4=0.001),
    # Near KITTI-360's image_02.
    "mei": build("mei", **_SENSOR | {"fx": 1336.0, "fy": 1336.0}, xi=2.21, k1=0.0169, k2=1.6548, p1=4e-4, p2=4e-4),
    "eucm": build("eucm", **_SENSOR, alpha=0.6, beta=1.1),
}


JPEG_QUALITY, PLASTER_PX, PLASTER = 90, 6, 13.0
"""Quality of a picture, and texture of its walls in pixels and in grey values (standard deviation). With this texture,
the inspection rates pictures as sharp as those of a street, and an image of 1400² has half a megabyte."""

FISHEYES = ("double_sphere", "kannala_brandt", "mei", "eucm")
"""Cameras whose image is a circle that touches the borders; the corners are masked."""


def camera_of(model: str, side_px: int) -> Camera:
    """One of `CAMERAS`, for an image of so many pixels a side."""
    return scaled(CAMERAS[model], side_px / IMAGE_PX, side_px / IMAGE_PX)


def objective_of(
    camera: Camera, frames: int, start: Matrix4, box: SearchBox, points: int = POINTS
) -> MutualInformation:
    """The objective of a window of so many frames and points per sweep, as the service builds it."""
    rig = rig_of(camera)
    of_map = scaled(camera, MAP_PX / IMAGE_PX, MAP_PX / IMAGE_PX)
    features = [_features(of_map, seed, points) for seed in range(frames)]
    return build_mutual_information(features, rig, start, box, ObjectiveConfig())


def rig_of(camera: Camera) -> Rig:
    """The camera at its true place, with the mask of its image circle."""
    across = np.arange(camera.width) - camera.cx
    circle = across**2 + across[:, None] ** 2 <= (camera.width / 2) ** 2
    return Rig("bench", camera, "camera", "lidar", T_TRUE, np.eye(4), circle if name_of(camera) in FISHEYES else None)


def pair(camera: Camera, seed: int, stamp_ns: int, points: int = POINTS) -> FramePair:
    """A picture and a sweep of the same room, as sensors would send them; the vehicle's motion is not known."""
    return FramePair(picture(camera, seed, stamp_ns), sweep(seed, stamp_ns, points))


def picture(camera: Camera, seed: int, stamp_ns: int) -> CameraFrame:
    """A JPEG of walls in coarse plaster, darker where they are nearer."""
    rng, phases = _room(seed)
    side_px = camera.width
    rays, valid = _pixel_rays(camera)
    grey = np.where(valid, 20.0 + 8.0 * _walls_m(rays, phases), 0.0)
    cells = -(-side_px // PLASTER_PX)
    texture = PLASTER * rng.standard_normal((cells, cells), np.float32)
    texture = texture.repeat(PLASTER_PX, axis=0).repeat(PLASTER_PX, axis=1)[:side_px, :side_px]
    pixels = np.clip(grey.reshape(side_px, side_px) + texture, 0, 255).astype(np.uint8)
    jpeg = encode_jpeg(np.repeat(pixels[:, :, None], 3, axis=2), JPEG_QUALITY)
    return CameraFrame(stamp_ns, "camera", EncodedImage(ImageFormat.JPEG, side_px, side_px, jpeg), sequence=seed)


def sweep(seed: int, stamp_ns: int, points: int = POINTS) -> LidarFrame:
    """A turn of so many points with intensity and ring; 2 MB with the usual number."""
    rng, phases = _room(seed)
    rays = _beams(points)
    range_m = _measured_m(rays, phases, rng)
    ring = np.repeat(np.arange(BEAMS, dtype=np.uint16), -(-points // BEAMS))[:points]
    intensity = rng.random(points).astype(np.float32)
    xyz_m = (rays * range_m[:, None]).astype(np.float32)
    return LidarFrame(stamp_ns, "lidar", xyz_m, intensity, ring, sequence=seed)


def first(frames: BinnedFrames, count: int) -> BinnedFrames:
    """The first so many frames of a window."""
    points = frames.first_point[count]
    return replace(
        frames,
        xyz_m=np.ascontiguousarray(frames.xyz_m[:, :points]),
        range_bin=frames.range_bin[:points],
        depth_bin=frames.depth_bin[:count],
        first_point=frames.first_point[: count + 1],
        bundles=None,
    )


def repeated(frames: BinnedFrames, times: int) -> BinnedFrames:
    """A window with the frames repeated `times` times, each copy at its own place in memory."""
    shifts = np.arange(times)[:, None] * frames.first_point[-1]
    return replace(
        frames,
        xyz_m=np.tile(frames.xyz_m, (1, times)),
        range_bin=np.tile(frames.range_bin, times),
        depth_bin=np.tile(frames.depth_bin, (times, 1)),
        first_point=np.append((shifts + frames.first_point[:-1]).ravel(), times * frames.first_point[-1]),
    )


def _features(camera: Camera, seed: int, points: int) -> Features:
    rng, phases = _room(seed)
    rays = _beams(points)
    range_m = _measured_m(rays, phases, rng)
    u, v = np.meshgrid(np.arange(MAP_PX, dtype=np.float64), np.arange(MAP_PX, dtype=np.float64))
    of_pixels, valid = unproject(camera, np.column_stack([u.ravel(), v.ravel()]))
    depth_m = np.where(valid, _walls_m(of_pixels @ T_TRUE[:3, :3], phases), np.nan).reshape(MAP_PX, MAP_PX)
    return Features(
        (rays * range_m[:, None]).astype(np.float32), range_m.astype(np.float32), depth_m.astype(np.float32)
    )


def _room(seed: int) -> tuple[np.random.Generator, NDArray[np.float64]]:
    """The random generator of a room, and the four phases (rad) of its walls."""
    rng = np.random.default_rng(seed)
    return rng, rng.uniform(0.0, 2.0 * np.pi, 4)


@lru_cache(maxsize=1)
def _pixel_rays(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(N, 3) unit directions of the pixels, LiDAR frame, row by row, and which of them are valid."""
    across = np.arange(camera.width, dtype=np.float64)
    rays, valid = unproject(camera, np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2))
    return rays @ T_TRUE[:3, :3], valid


def _beams(points: int) -> NDArray[np.float64]:
    """(`points`, 3) unit directions of a turn, LiDAR frame, beam by beam."""
    steps = -(-points // BEAMS)
    azimuth = np.tile(np.linspace(-np.pi, np.pi, steps, endpoint=False), BEAMS)[:points]
    elevation = np.repeat(np.linspace(HIGHEST_RAD, LOWEST_RAD, BEAMS), steps)[:points]
    return np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def _measured_m(
    rays: NDArray[np.float64], phases: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Range along each ray with the noise of a LiDAR."""
    return np.asarray(_walls_m(rays, phases) * (1.0 + 0.005 * rng.standard_normal(len(rays))))


def _walls_m(rays: NDArray[np.float64], phases: NDArray[np.float64]) -> NDArray[np.float64]:
    """Range of the wall in each direction (N, 3), LiDAR frame: hills, and pillars that stand out from it."""
    x, y, z = rays.T
    azimuth = np.arctan2(y, x)
    hills = 14.0 + 5.0 * np.sin(2.0 * azimuth + phases[0]) + 8.0 * z + 4.0 * np.sin(7.0 * z + phases[1])
    pillars = np.sin(9.0 * azimuth + phases[2]) * np.cos(11.0 * z + phases[3]) > 0.3
    return np.asarray(np.where(pillars, 0.6 * hills, hills))
