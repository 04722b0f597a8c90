"""Calculations with the poses of a configuration; the only module of `config` that needs NumPy.

Other modules import it inside the functions that read a pose, not at their top, so that reading a configuration without
a rig does not import NumPy.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.config.model import Matrix4x4
from coec.geometry import cameras, se3

VIEW_DISTANCE_M = 15.0
"""Distance at which the common view of two sensors is judged. It is about the geometric middle of the 2 to 80 m in
which points count, and large against half the width of a vehicle."""

AZIMUTHS, ELEVATIONS = 120, 9
"""Directions that are tested for a LiDAR: azimuths over the full circle, elevations within its own. They are dense
enough that a telephoto lens of 10° sees some."""


def rows_of(xyz_m: tuple[float, float, float], quaternion_xyzw: tuple[float, float, float, float]) -> Matrix4x4:
    """The pose with a position, metres, and a rotation.

    Raises:
        ValueError: the quaternion is zero.
    """
    return _rows(se3.transform_from(se3.rotation_from_quaternion_xyzw(np.array(quaternion_xyzw)), np.array(xyz_m)))


def rows_of_angles(xyz_m: tuple[float, float, float], rpy: tuple[float, float, float], *, degrees: bool) -> Matrix4x4:
    """The pose with a position, metres, and roll, pitch, yaw about the fixed axes x, y, z, in degrees or radians."""
    roll, pitch, yaw = (se3.rotation_exp(turn) for turn in np.diag(np.radians(rpy) if degrees else np.array(rpy)))
    return _rows(se3.transform_from(yaw @ pitch @ roll, np.array(xyz_m)))


def rigidity_problem(rows: Matrix4x4) -> str:
    """Why the matrix is not a rotation and a translation; empty if it is."""
    T = np.array(rows)
    if se3.is_rigid(T):
        return ""
    expected, rotation = "rows of a rotation, a translation, then 0 0 0 1", T[:3, :3]
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        transposed = " (is it transposed?)" if np.array_equal(T[:, 3], [0.0, 0.0, 0.0, 1.0]) else ""
        return f"{expected}; its last row is {' '.join(f'{value:g}' for value in T[3])}{transposed}"
    with np.errstate(over="ignore", invalid="ignore"):
        off, mirrored = np.abs(rotation.T @ rotation - np.eye(3)).max(), np.linalg.det(rotation) < 0.0
    if off < LOOSE and mirrored:
        return f"{expected}; its determinant is -1, so it mirrors: an axis has the wrong sign, or two are exchanged"
    return f"{expected}; its rows are orthonormal only to {off:.1g}: give more digits, or a quaternion"


LOOSE = 1e-2
"""Entries of RᵀR - 1 up to which a matrix is a rotation with few digits, perhaps mirrored."""


def inverse(T_a_b: Matrix4x4) -> Matrix4x4:
    """T_b_a of a rigid T_a_b."""
    return _rows(se3.inverse(np.array(T_a_b)))


def product(T_a_b: Matrix4x4, T_b_c: Matrix4x4) -> Matrix4x4:
    """T_a_c."""
    return _rows(np.array(T_a_b) @ np.array(T_b_c))


def relative(T_vehicle_a: Matrix4x4, T_vehicle_b: Matrix4x4) -> Matrix4x4:
    """T_a_b, which maps b coordinates to a coordinates, from the poses of both in the vehicle's frame. Its rotation is
    orthonormal to rounding, however few digits the rotations of the poses have."""
    T_a_b = se3.inverse(np.array(T_vehicle_a)) @ np.array(T_vehicle_b)
    unit = se3.rotation_from_quaternion_xyzw(se3.quaternion_xyzw_from_rotation(T_a_b[:3, :3]))
    return _rows(se3.transform_from(unit, T_a_b[:3, 3]))


@dataclass(frozen=True, slots=True)
class CommonView:
    """How much a camera and a LiDAR see in common, as shares from 0 to 1.

    Attributes:
        of_lidar: share of the LiDAR's directions that fall on a pixel.
        of_camera: share, of the directions that the camera would see if the LiDAR measured all around, in which the
            LiDAR does measure.
    """

    of_lidar: float
    of_camera: float


def common_view(
    model: str,
    intrinsics: dict[str, float],
    T_camera_lidar: Matrix4x4,
    azimuth_deg: tuple[float, float],
    elevation_deg: tuple[float, float],
) -> CommonView:
    """How much both see in common. Obstacles in between, such as the vehicle itself, are not taken into account.

    Args:
        model, intrinsics: of the camera, see `CameraIntrinsics`.
        azimuth_deg, elevation_deg: (from, to) of the LiDAR's field of view; counter-clockwise from its x, and up.

    Raises:
        ValueError: an intrinsic parameter is missing, not of this model, or out of range.
    """
    camera = cameras.build(model, **intrinsics)
    turn_deg = (np.arange(AZIMUTHS) + 0.5) * 360.0 / AZIMUTHS
    low_deg, high_deg = elevation_deg
    up_deg = low_deg + (high_deg - low_deg) * (np.arange(ELEVATIONS) + 0.5) / ELEVATIONS
    turn_rad, up_rad = (np.radians(grid.ravel()) for grid in np.meshgrid(turn_deg + azimuth_deg[0], up_deg))
    level = VIEW_DISTANCE_M * np.cos(up_rad)
    p_lidar = np.stack([level * np.cos(turn_rad), level * np.sin(turn_rad), VIEW_DISTANCE_M * np.sin(up_rad)], axis=1)
    T = np.array(T_camera_lidar)
    projected = [cameras.project_point(camera, *point) for point in (p_lidar @ T[:3, :3].T + T[:3, 3]).tolist()]
    seen = cameras.in_image(camera, np.array([(u, v) for u, v, _ in projected]))
    seen &= np.array([valid for _, _, valid in projected])
    measured = np.tile(turn_deg < azimuth_deg[1] - azimuth_deg[0], ELEVATIONS)
    both = float((seen & measured).sum())
    return CommonView(both / max(float(measured.sum()), 1.0), both / max(float(seen.sum()), 1.0))


def _rows(T: NDArray[np.float64]) -> Matrix4x4:
    # Adding zero turns -0.0 into 0.0.
    a, b, c, d = ((float(w), float(x), float(y), float(z)) for w, x, y, z in T + 0.0)
    return a, b, c, d
