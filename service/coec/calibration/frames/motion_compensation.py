"""Motion compensation of a pair: the sweep as it would have been measured at the instant of the exposure."""

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.pairing import azimuth_offsets_s
from coec.calibration.types import Compensation, EgoMotion, FramePair, LidarFrame, Matrix4, Rig, SweepTiming
from coec.geometry.sweep_kernels import deskew

Choice = NDArray[np.int64] | slice
"""Which points of a sweep: indices, or a slice."""

EVERY = slice(None)
"""All points, without a copy."""


def compensate(pair: FramePair, rig: Rig, *, enabled: bool, selection: Choice = EVERY) -> NDArray[np.float32]:
    """(N, 3) float32: the chosen points of the sweep in the LiDAR frame at the camera stamp.

    Per-point time comes with the cloud, or follows from azimuth (`rig.sweep`). Without either, the whole sweep is moved
    from its stamp to the camera's. Without ego-motion nothing is moved. If only the rotation is known, points are
    turned and not shifted.
    """
    xyz_m = np.ascontiguousarray(pair.lidar.xyz_m[selection])
    if not enabled or pair.motion is None:
        return xyz_m
    dt_s = _point_offsets_s(pair.lidar, xyz_m, rig.sweep, selection)
    dt_s += (pair.lidar.stamp_ns - pair.camera.stamp_ns) * 1e-9
    angular, linear = sensor_twist(pair.motion, rig.T_lidar_ego)
    return deskew(xyz_m, dt_s, angular, linear)


def compensation(pair: FramePair, rig: Rig, *, enabled: bool) -> Compensation:
    """What `compensate` does to the sweep of a pair."""
    if not enabled:
        return Compensation.DISABLED
    if pair.motion is None:
        return Compensation.NO_EGO_MOTION
    if pair.lidar.time_offset_s is None and rig.sweep is None:
        return Compensation.NO_POINT_TIME
    return Compensation.ROTATION_ONLY if pair.motion.linear_mps is None else Compensation.DONE


def sensor_twist(motion: EgoMotion, T_lidar_ego: Matrix4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angular (3,) rad/s and linear velocity (3,) m/s of the LiDAR in its own frame, with the velocity that its lever
    arm adds in a turn. If the linear velocity of the vehicle is unknown, that of the LiDAR is zero."""
    rotation = T_lidar_ego[:3, :3]
    angular = np.asarray(motion.angular_radps)
    if motion.linear_mps is None:
        return rotation @ angular, np.zeros(3)
    # The lever is the place of the LiDAR in the vehicle's frame. Plain numbers, because arrays of three are slow.
    (a, b, c), (x, y, z) = motion.angular_radps, (-rotation.T @ T_lidar_ego[:3, 3]).tolist()
    linear = np.asarray(motion.linear_mps) + np.array([b * z - c * y, c * x - a * z, a * y - b * x])
    return rotation @ angular, rotation @ linear


def _point_offsets_s(
    lidar: LidarFrame, xyz_m: NDArray[np.float32], sweep: SweepTiming | None, selection: Choice
) -> NDArray[np.float64]:
    if lidar.time_offset_s is not None:
        return lidar.time_offset_s[selection].astype(np.float64)
    return np.zeros(len(xyz_m)) if sweep is None else azimuth_offsets_s(xyz_m, sweep)
