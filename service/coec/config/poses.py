"""Poses as people write them and what they come to: the one room of the configuration that calculates.

Others import it where a pose is read, not at their head: whoever reads a configuration without a rig needs no NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.config.base import Matrix4x4
from coec.geometry import cameras, se3

LOOKED_AT_M = 15.0
"""Distance at which it is judged what two sensors see: the middle, on a scale of logarithms, of 2 to 80 m in which
points count. Beside it half the width of a vehicle is little."""

AZIMUTHS, ELEVATIONS = 120, 9
"""Directions, all around and within its elevations, in which a LiDAR is looked at: the view of a telephoto lens of 10°
holds some."""


def rows_of(xyz_m: tuple[float, float, float], quaternion_xyzw: tuple[float, float, float, float]) -> Matrix4x4:
    """The pose of a place, metres, and a rotation.

    Raises:
        ValueError: the quaternion is zero.
    """
    return _rows(se3.transform_from(se3.rotation_from_quaternion_xyzw(np.array(quaternion_xyzw)), np.array(xyz_m)))


def is_rigid(rows: Matrix4x4) -> bool:
    """Whether it is a rotation and a translation."""
    return se3.is_rigid(np.array(rows))


def relative(T_vehicle_a: Matrix4x4, T_vehicle_b: Matrix4x4) -> Matrix4x4:
    """T_a_b, which maps what b sees to a, of the poses of both in the vehicle's frame. Its rotation is one to the last
    bit, however few digits those of the poses have."""
    T_a_b = se3.inverse(np.array(T_vehicle_a)) @ np.array(T_vehicle_b)
    unit = se3.rotation_from_quaternion_xyzw(se3.quaternion_xyzw_from_rotation(T_a_b[:3, :3]))
    return _rows(se3.transform_from(unit, T_a_b[:3, 3]))


@dataclass(frozen=True, slots=True)
class Common:
    """What a camera and a LiDAR both see, as shares of 0 to 1.

    Attributes:
        of_lidar: of the directions in which the LiDAR measures, those that have a pixel.
        of_camera: of what the camera would see of such a LiDAR that measured all around.
    """

    of_lidar: float
    of_camera: float


def common(
    model: str,
    intrinsics: dict[str, float],
    T_camera_lidar: Matrix4x4,
    azimuth_deg: tuple[float, float],
    elevation_deg: tuple[float, float],
) -> Common:
    """What both see. What stands in between, the vehicle itself for instance, is not known here.

    Args:
        model, intrinsics: of the camera, see `CameraIntrinsics`.
        azimuth_deg, elevation_deg: from where to where the LiDAR measures; counter-clockwise from its x, and up.

    Raises:
        ValueError: an intrinsic parameter is missing, not of this model, or out of range.
    """
    camera = cameras.build(model, **intrinsics)
    turn_deg = (np.arange(AZIMUTHS) + 0.5) * 360.0 / AZIMUTHS
    low_deg, high_deg = elevation_deg
    up_deg = low_deg + (high_deg - low_deg) * (np.arange(ELEVATIONS) + 0.5) / ELEVATIONS
    turn_rad, up_rad = (np.radians(grid.ravel()) for grid in np.meshgrid(turn_deg + azimuth_deg[0], up_deg))
    level = LOOKED_AT_M * np.cos(up_rad)
    p_lidar = np.stack([level * np.cos(turn_rad), level * np.sin(turn_rad), LOOKED_AT_M * np.sin(up_rad)], axis=1)
    T = np.array(T_camera_lidar)
    projected = [cameras.project_point(camera, *point) for point in (p_lidar @ T[:3, :3].T + T[:3, 3]).tolist()]
    seen = cameras.in_image(camera, np.array([(u, v) for u, v, _ in projected]))
    seen &= np.array([valid for _, _, valid in projected])
    measured = np.tile(turn_deg < azimuth_deg[1] - azimuth_deg[0], ELEVATIONS)
    both = float((seen & measured).sum())
    return Common(both / max(float(measured.sum()), 1.0), both / max(float(seen.sum()), 1.0))


def _rows(T: NDArray[np.float64]) -> Matrix4x4:
    # Adding zero makes no minus of a nought.
    a, b, c, d = ((float(w), float(x), float(y), float(z)) for w, x, y, z in T + 0.0)
    return a, b, c, d
