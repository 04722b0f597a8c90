"""Sweeps of a turning LiDAR that nobody drove: rings, walls and ground, in its own frame and in a vehicle's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import LidarFrame
from coec.geometry import se3

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
