"""Motion compensation of a pair: the sweep as it would have been measured at the instant of the exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.calibration.values import Compensation, EgoMotion, FramePair, LidarFrame, Matrix4, Rig, SweepTiming
from coec.geometry import se3
from coec.geometry.sweep import deskew


@dataclass(frozen=True, slots=True, eq=False)
class CompensatedCloud:
    """(N, 3) float32 points in the LiDAR frame at the camera stamp, and what was done to them."""

    xyz_m: NDArray[np.float32]
    outcome: Compensation


def compensate(pair: FramePair, rig: Rig, *, enabled: bool) -> CompensatedCloud:
    """Carries every point of the sweep to the camera stamp.

    Per-point time comes with the cloud, or follows from azimuth (`rig.sweep`). Without either, the sweep is moved as a
    whole from its stamp to the camera's and the outcome says `NO_POINT_TIME`. Without ego-motion nothing is moved.
    """
    if not enabled:
        return CompensatedCloud(pair.lidar.xyz_m, Compensation.DISABLED)
    if pair.motion is None:
        return CompensatedCloud(pair.lidar.xyz_m, Compensation.NO_EGO_MOTION)
    offset_s, outcome = _point_offsets_s(pair.lidar, rig.sweep)
    dt_s = offset_s + (pair.lidar.stamp_ns - pair.camera.stamp_ns) * 1e-9
    angular, linear = sensor_twist(pair.motion, rig.T_lidar_ego)
    return CompensatedCloud(deskew(pair.lidar.xyz_m, dt_s, angular, linear), outcome)


def azimuth_offsets_s(xyz_m: NDArray[np.float32], sweep: SweepTiming) -> NDArray[np.float64]:
    """(N,) seconds after the sweep's stamp at which each point was measured, from its azimuth (see `SweepTiming`)."""
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0]).astype(np.float64) - sweep.stamp_azimuth_rad
    revolutions = azimuth / (2.0 * np.pi)
    revolutions -= np.rint(revolutions)
    return sweep.sign * sweep.period_s * revolutions


def sensor_twist(motion: EgoMotion, T_lidar_ego: Matrix4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angular (3,) rad/s and linear velocity (3,) m/s of the LiDAR in its own frame; the lever arm turns rotation into
    velocity."""
    rotation = T_lidar_ego[:3, :3]
    lidar_in_ego_m = se3.inverse(T_lidar_ego)[:3, 3]
    angular = np.asarray(motion.angular_radps)
    linear = np.asarray(motion.linear_mps) + np.cross(angular, lidar_in_ego_m)
    return rotation @ angular, rotation @ linear


def _point_offsets_s(lidar: LidarFrame, sweep: SweepTiming | None) -> tuple[NDArray[np.float64], Compensation]:
    if lidar.time_offset_s is not None:
        return lidar.time_offset_s.astype(np.float64), Compensation.DONE
    if sweep is not None:
        return azimuth_offsets_s(lidar.xyz_m, sweep), Compensation.DONE
    return np.zeros(len(lidar.xyz_m)), Compensation.NO_POINT_TIME
