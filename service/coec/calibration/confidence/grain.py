"""How fine the sensors of a window are: the units of the budget of systematic errors."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

import numpy as np
from numpy.typing import NDArray

from coec.calibration.confidence.lens_limit import lens_error_px
from coec.calibration.types import LidarFrame, Matrix4, Window
from coec.geometry.cameras import pixel_rad
from coec.geometry.edges.range_edges import NEIGHBOUR_RAD
from coec.geometry.edges.scan_lines import BAND_RAD, distinct_rings

LENS_PX = 0.05
"""Error that a target-based calibration of a lens leaves in its principal point, and in its scale at the rim. It is
half of the 0.1 px to which a corner is found, because its pictures hold a few independent corners near every place of
the image. On simulated drives, whose lens is exact, twice as much made the claimed σ along the optical axis 3.6 times
as wide as the error."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorResolution:
    """The grain of one window.

    Attributes:
        pixel_rad: the angle of a pixel on the optical axis.
        lens_px: standard deviation of the camera model, pixels.
        column_rad: the turn between two firings of a beam.
        velocity_mps, turn_radps: (F, 3) of the LiDAR in each pair, camera frame; zero if unknown.
        held_m: standard deviation of a held camera centre, along each axis.
    """

    pixel_rad: float
    lens_px: float
    column_rad: float
    velocity_mps: NDArray[np.float64]
    turn_radps: NDArray[np.float64]
    held_m: float


def sensor_resolution(window: Window, T_camera_lidar: Matrix4, held_m: float) -> SensorResolution:
    """The grain of a window whose camera is at `T_camera_lidar` (4, 4); a held centre is known to `held_m`."""
    velocity_mps, turn_radps = _rates(window, T_camera_lidar)
    return SensorResolution(
        pixel_rad=pixel_rad(window.rig.camera),
        lens_px=hypot(LENS_PX, lens_error_px(window.rig.camera_residual_px)),
        column_rad=column_rad(window.pairs[0].lidar),
        velocity_mps=velocity_mps,
        turn_radps=turn_radps,
        held_m=held_m,
    )


def column_rad(sweep: LidarFrame) -> float:
    """Median turn between neighbours of a scan line, radians; without usable rings, of a row of nearly equal elevation.
    0 if no point has a neighbour."""
    x, y, z = (sweep.xyz_m[:, axis].astype(np.float64) for axis in range(3))
    azimuth, across = np.arctan2(y, x), np.hypot(x, y)
    ring = distinct_rings(sweep.ring)
    row = np.floor(np.arctan2(z, across) / BAND_RAD) if ring is None else ring.astype(np.float64)
    order = np.lexsort((azimuth, row))
    turn = np.diff(azimuth[order])
    neighbours = turn[(np.diff(row[order]) == 0.0) & (turn > 0.0) & (turn < NEIGHBOUR_RAD)]
    return float(np.median(neighbours)) if len(neighbours) else 0.0


def _rates(window: Window, T_camera_lidar: Matrix4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    R_camera_lidar, T_lidar_ego = T_camera_lidar[:3, :3], window.rig.T_lidar_ego
    velocity, turn = np.zeros((len(window.pairs), 3)), np.zeros((len(window.pairs), 3))
    for index, pair in enumerate(window.pairs):
        if pair.motion is None:
            continue
        omega = T_lidar_ego[:3, :3] @ np.array(pair.motion.angular_radps)
        # The origin of the ego frame is not at the LiDAR: a turn carries the LiDAR around it.
        turn[index] = R_camera_lidar @ omega
        if pair.motion.linear_mps is None:
            continue
        linear = T_lidar_ego[:3, :3] @ np.array(pair.motion.linear_mps) - np.cross(omega, T_lidar_ego[:3, 3])
        velocity[index] = R_camera_lidar @ linear
    return velocity, turn
