"""Two sweeps as they would have been measured at one instant, that of the first one's stamp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.lidar_to_lidar.types import LidarRig, SweepPair
from coec.calibration.types import EgoMotion, LidarFrame, Matrix4
from coec.geometry import se3
from coec.geometry.deskew import deskew
from coec.geometry.vectors import lengths

Doubles = NDArray[np.float64]

THINNED_M = 0.3
"""One point of b in every cube of this size: what is near would else count for everything."""
NEAREST_M, FURTHEST_M = 0.5, 60.0
"""Points of b that are used; further ones have no surfaces of a about them."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of both at one instant.

    Attributes:
        a_m: (N, 3) in the frame of a.
        b_m: (M, 3) in the frame of b, thinned.
        twist: (6,) of a in its own frame, rad/s and m/s; zero where it is not known.
    """

    a_m: Doubles
    b_m: Doubles
    twist: Doubles


def clouds_of(rig: LidarRig, pair: SweepPair) -> Cloud:
    """Motion-compensated by the time of each point; a sweep without such times, or without ego-motion, as it is."""
    instant_ns = pair.a.stamp_ns
    twist = np.zeros(6)
    if pair.motion is not None:
        angular, linear = sensor_twist(pair.motion, rig.T_a_ego)
        twist = np.concatenate([angular, linear])
    T_b_ego = se3.inverse(rig.T_a_b_nominal) @ rig.T_a_ego
    a_m = _at(pair.a, instant_ns, pair.motion, rig.T_a_ego)
    b_m = _at(pair.b, instant_ns, pair.motion, T_b_ego)
    range_m = lengths(b_m)
    return Cloud(a_m, _thinned(b_m[(range_m > NEAREST_M) & (range_m < FURTHEST_M)]), twist)


def _at(sweep: LidarFrame, instant_ns: int, motion: EgoMotion | None, T_lidar_ego: Matrix4) -> Doubles:
    xyz_m = np.ascontiguousarray(sweep.xyz_m)
    if motion is None:
        return xyz_m.astype(np.float64)
    offsets = np.zeros(len(xyz_m)) if sweep.time_offset_s is None else sweep.time_offset_s.astype(np.float64)
    angular, linear = sensor_twist(motion, T_lidar_ego)
    moved = deskew(xyz_m, offsets + (sweep.stamp_ns - instant_ns) * 1e-9, angular, linear)
    return moved.astype(np.float64)


def _thinned(points_m: Doubles) -> Doubles:
    """The first point of each cube."""
    cubes = np.floor(points_m / THINNED_M).astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    return points_m[np.sort(first)]
