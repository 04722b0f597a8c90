"""A street that does not exist: a small seeded recording with known truth, for runs without any data.

A vehicle with a double sphere fisheye (190°) and a spinning LiDAR of 32 beams drives along two rows of
buildings, parked cars and poles. Images, exact depth and sweeps are cast analytically against one list of
boxes and the ground. World and ego frame (rear axle, on the ground): x forward, y left, z up. The nominal
calibration of the rig is the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from coec.adapters.images.codec import encode_depth_png, encode_jpeg
from coec.calibration.types import (
    CameraFrame,
    EgoMotion,
    EncodedImage,
    ImageFormat,
    LidarFrame,
    Matrix4,
    Rig,
)
from coec.errors import UsageError
from coec.geometry.cameras import Camera, build
from coec.geometry.projection import unproject
from coec.geometry.se3 import rotation_exp
from coec.sources.recording import FramewiseRecording, RecordedFrame, Recording
from coec.sources.synthetic_street import SKY, Floats, Street, build_street

START_NS = 1_600_000_000_000_000_000
CAMERA_DELAY_NS = 10_000_000
"""The camera exposes this much after the stamp of its sweep, so that motion compensation has work to do."""

SPEED_MPS, SWAY_M, SWAY_RAD_PER_M = 7.0, 1.2, 2 * np.pi / 60
SWEEP_S, BEAMS, COLUMNS = 0.1, 32, 600
ELEVATIONS_RAD = np.deg2rad(np.linspace(-24.0, 12.0, BEAMS))
RANGE_NOISE_M, LIDAR_REACH_M, CAMERA_REACH_M = 0.02, 100.0, 120.0
HALF_VIEW_RAD = np.deg2rad(95.0)
XI, ALPHA = -0.2, 0.6  # near those of common fisheyes
NEAREST_M = 2.0
"""Range whose inverse has the largest depth code, 65535."""

P_EGO_CAMERA_M, P_EGO_LIDAR_M = np.array([1.65, 0.05, 1.8]), np.array([1.5, 0.0, 1.9])
"""Near each other, as in one housing: range from the LiDAR (METHOD, section 1) is not range from the camera,
and the maximum of MI moves with the lever arm: 0.4° in pitch at 0.9 m and 0.4 m, under 0.12° here
(measured)."""
MOUNT_RAD = np.deg2rad([4.0, -2.0, 1.0])
"""Rotation of the camera about its x, y, z axes from looking straight ahead."""

JPEG_QUALITY = 90
MOTION_PERIOD_NS, MOTION_SAMPLES = 20_000_000, 7
"""Ego-motion at 50 Hz, this many samples before and after each exposure."""

KEYS: dict[str, tuple[float, float, float]] = {
    "seed": (0, 0, 2**32 - 1),
    "frames": (12, 1, 1000),
    "period_s": (15, 0.2, 60),
    "width": (480, 64, 2048),
}
"""Query keys: default, least and largest value. 12 frames, 15 s apart, fill one default slice of 180 s."""


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """The sensors on their way: forward at `SPEED_MPS`, swaying `SWAY_M` to each side of the middle.

    Attributes:
        rays: (P, 3) unit directions, camera frame, of the pixels that are `seen`, row by row.
        seen: (height, width), true within the image circle.
    """

    street: Street
    seed: int
    camera: Camera
    rays: Floats
    seen: NDArray[np.bool_]

    def pose(self, time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation (..., 3, 3) from ego to world and position (..., 3) of the rear axle, m."""
        x = SPEED_MPS * time_s
        heading = np.arctan(SWAY_M * SWAY_RAD_PER_M * np.cos(SWAY_RAD_PER_M * x))
        cosine, sine, zero = np.cos(heading), np.sin(heading), np.zeros_like(heading)
        rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1]
        rotation = np.stack(rows, axis=-1).reshape(*heading.shape, 3, 3)
        return rotation, np.stack([x, SWAY_M * np.sin(SWAY_RAD_PER_M * x), zero], axis=-1)

    def motion(self, stamp_ns: int) -> EgoMotion:
        """Exact twist of the rear axle, which moves where it points."""
        phase = SWAY_RAD_PER_M * SPEED_MPS * (stamp_ns - START_NS) / 1e9
        slope = SWAY_M * SWAY_RAD_PER_M * np.cos(phase)
        bend = -SWAY_M * SWAY_RAD_PER_M**2 * np.sin(phase)
        speed_mps = float(SPEED_MPS * np.sqrt(1 + slope**2))
        yaw_radps = float(SPEED_MPS * bend / (1 + slope**2))
        return EgoMotion(stamp_ns, "ego", (speed_mps, 0.0, 0.0), (0.0, 0.0, yaw_radps))

    def expose(self, stamp_ns: int, index: int) -> CameraFrame:
        """The image and its exact depth: code 65535 · `NEAREST_M` / range from the camera, 1 for the sky."""
        rotation, position = self.pose(np.asarray((stamp_ns - START_NS) / 1e9))
        directions = np.einsum("ij,nj->ni", rotation @ camera_axes(), self.rays).astype(np.float32)
        origin = (rotation @ P_EGO_CAMERA_M + position).astype(np.float32)
        range_m, hit = self.street.cast(np.broadcast_to(origin, directions.shape), directions, CAMERA_REACH_M)
        at_m = np.where(hit == SKY, np.float32(CAMERA_REACH_M), range_m)
        colour = self.street.shade(origin + directions * at_m[:, None], directions, at_m, hit)
        noise = np.random.default_rng([self.seed, index, 0]).normal(0, 2, len(colour))
        height, width = self.seen.shape
        image = np.zeros((height, width, 3), dtype=np.uint8)
        image[self.seen] = np.clip(255 * colour + noise[:, None], 0, 255)
        code = np.zeros((height, width), dtype=np.uint16)
        code[self.seen] = np.clip(65535 * NEAREST_M / range_m, 1, 65535)
        return CameraFrame(
            stamp_ns,
            "camera",
            EncodedImage(ImageFormat.JPEG, width, height, encode_jpeg(image, JPEG_QUALITY)),
            sequence=index,
            depth=EncodedImage(ImageFormat.PNG, width, height, encode_depth_png(code)),
        )

    def sweep(self, stamp_ns: int, index: int) -> LidarFrame:
        """One turn, clockwise from the rear, stamped as it looks forward.

        Every column is measured from where the vehicle is at its own time, so the sweep is skewed by motion.
        """
        rng = np.random.default_rng([self.seed, index, 1])
        azimuth = np.pi - 2 * np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS
        offset_s = np.repeat(-SWEEP_S * azimuth / (2 * np.pi), BEAMS)
        flat, up = np.tile(np.cos(ELEVATIONS_RAD), COLUMNS), np.tile(np.sin(ELEVATIONS_RAD), COLUMNS)
        azimuth = np.repeat(azimuth, BEAMS)
        rays = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up])
        rotation, position = self.pose((stamp_ns - START_NS) / 1e9 + offset_s)
        directions = np.einsum("nij,nj->ni", rotation, rays).astype(np.float32)
        origins = (rotation @ P_EGO_LIDAR_M + position).astype(np.float32)
        range_m, hit = self.street.cast(origins, directions, LIDAR_REACH_M)
        seen = hit != SKY
        measured_m = range_m[seen] + rng.normal(0, RANGE_NOISE_M, int(seen.sum()))
        return LidarFrame(
            stamp_ns,
            "lidar",
            (rays[seen] * measured_m[:, None]).astype(np.float32),
            ring=np.tile(np.arange(BEAMS, dtype=np.uint16), COLUMNS)[seen],
            time_offset_s=offset_s[seen].astype(np.float32),
            sequence=index,
        )


def camera_axes() -> NDArray[np.float64]:
    """(3, 3) rotation from camera to ego: looking ahead, turned by `MOUNT_RAD`."""
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return ahead @ rotation_exp(MOUNT_RAD)


def true_extrinsic() -> Matrix4:
    """T_camera_lidar (4, 4)."""
    transform = np.eye(4)
    transform[:3, :3] = camera_axes().T
    transform[:3, 3] = camera_axes().T @ (P_EGO_LIDAR_M - P_EGO_CAMERA_M)
    return transform


def open_synthetic(query: dict[str, str]) -> Recording:
    """The recording of `synthetic:?seed=0&frames=12&period_s=15&width=480`; every key may be left out.

    Raises:
        UsageError: an unknown key, not a number, or out of range; names the key.
    """
    unknown = sorted(set(query) - set(KEYS))
    if unknown:
        raise UsageError(f"unknown query key {', '.join(unknown)} of a synthetic source; known: {', '.join(KEYS)}")
    values = {key: _number(key, query.get(key, str(default)), low, high) for key, (default, low, high) in KEYS.items()}
    seed, frames, width = int(values["seed"]), int(values["frames"]), int(values["width"])
    period_ns = round(values["period_s"] * 1e9)
    camera, rays, seen = _lens(width)
    street = build_street(np.random.default_rng(seed), SPEED_MPS * period_ns / 1e9 * (frames - 1))
    vehicle = Vehicle(street, seed, camera, rays, seen)
    sweep_stamps_ns = [START_NS + index * period_ns for index in range(frames)]
    near_ns = np.arange(-MOTION_SAMPLES, MOTION_SAMPLES + 1) * MOTION_PERIOD_NS + CAMERA_DELAY_NS
    motion_stamps_ns = sorted({int(stamp + offset) for stamp in sweep_stamps_ns for offset in near_ns})
    T_lidar_ego = np.eye(4)
    T_lidar_ego[:3, 3] = -P_EGO_LIDAR_M
    rig = Rig("synthetic", camera, "camera", "lidar", true_extrinsic(), T_lidar_ego, mask=seen)
    return FramewiseRecording(
        f"synthetic street, seed {seed}",
        rig,
        rig.T_camera_lidar_nominal,
        tuple(
            RecordedFrame(
                stamp_ns + CAMERA_DELAY_NS,
                partial(vehicle.expose, stamp_ns + CAMERA_DELAY_NS, index),
                stamp_ns,
                partial(vehicle.sweep, stamp_ns, index),
            )
            for index, stamp_ns in enumerate(sweep_stamps_ns)
        ),
        tuple(vehicle.motion(stamp_ns) for stamp_ns in motion_stamps_ns),
    )


def _number(key: str, text: str, low: float, high: float) -> float:
    try:
        value = float(text) if key == "period_s" else int(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        kind = "a number" if key == "period_s" else "a whole number"
        raise UsageError(f"{key}={text} of a synthetic source: expected {kind} from {low} to {high}")
    return value


def _lens(width: int) -> tuple[Camera, Floats, NDArray[np.bool_]]:
    """A square camera whose image circle of 190° just fits; see `Vehicle` for its rays and its mask."""
    sine, cosine = np.sin(HALF_VIEW_RAD), np.cos(HALF_VIEW_RAD)
    shifted = XI + cosine
    # Usenko, Demmel, Cremers 2018, equations (40) to (42), at the rim: u - cx = fx · x / (α d2 + (1 - α) z').
    rim = sine / (ALPHA * np.hypot(sine, shifted) + (1 - ALPHA) * shifted)
    focal_px, centre_px = (width - 1) / 2 / rim, (width - 1) / 2
    camera = build(
        "double_sphere",
        width=width,
        height=width,
        fx=focal_px,
        fy=focal_px,
        cx=centre_px,
        cy=centre_px,
        xi=XI,
        alpha=ALPHA,
    )
    v, u = np.mgrid[0:width, 0:width]
    rays, valid = unproject(camera, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    seen = valid & (rays[:, 2] >= cosine)
    return camera, rays[seen].astype(np.float32), seen.reshape(width, width)
