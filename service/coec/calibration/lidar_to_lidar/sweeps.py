"""Two sweeps as they would have been measured at one instant: the stamp of the sweep of a."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.frames.sweep_times import azimuth_offsets_s
from coec.calibration.lidar_to_lidar.types import LidarRig, SweepPair
from coec.calibration.types import EgoMotion, LidarFrame, Matrix4, SweepTiming
from coec.geometry import se3
from coec.geometry.deskew import deskew
from coec.geometry.vectors import lengths

DoublesOfSweeps = NDArray[np.float64]

THINNED_M = 0.3
"""One point of b is kept in every cube of this size; otherwise near things would count for everything."""
NEAREST_M, FURTHEST_M = 0.5, 60.0
"""Ranges of the points of b that are used; further ones have no surfaces of a around them."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points of both sweeps.

    Attributes:
        a_m: (N, 3) points of a in the frame of a, at the instant.
        raw_b_m: (M, 3) float32 points of b in the frame of b, each at its own instant; thinned.
        after_s: (M,) how much later than the instant each point of b was measured.
        motion: ego-motion at the instant; None if unknown.
        T_a_ego: (4, 4) maps ego coordinates to those of a.
    """

    a_m: DoublesOfSweeps
    raw_b_m: NDArray[np.float32]
    after_s: DoublesOfSweeps
    motion: EgoMotion | None
    T_a_ego: Matrix4

    def b_m(self, T_a_b: Matrix4) -> DoublesOfSweeps:
        """(M, 3) the points of b in the frame of b at the instant, if b has the pose T_a_b (4, 4) in a. They depend on
        that pose, because a turned LiDAR moves another way in its own frame: 1.4 cm aside in 90 ms at 8 m/s and 1°."""
        return _at(self.raw_b_m, self.after_s, self.motion, se3.inverse(T_a_b) @ self.T_a_ego)

    @property
    def twist(self) -> DoublesOfSweeps:
        """(6,) twist of a in its own frame, rad/s and m/s; zero if unknown."""
        if self.motion is None:
            return np.zeros(6)
        return np.concatenate(sensor_twist(self.motion, self.T_a_ego))


def clouds_of(rig: LidarRig, pair: SweepPair) -> Cloud:
    """The points of a pair of sweeps, motion-compensated by the time of each point. Without such times all points of a
    sweep have its stamp; without ego-motion nothing is moved."""
    a, b = pair.a, pair.b
    a_m = _at(np.ascontiguousarray(a.xyz_m), _offsets_s(a, rig.sweep_a), pair.motion, rig.T_a_ego)
    range_m = lengths(b.xyz_m)
    used = np.flatnonzero((range_m > NEAREST_M) & (range_m < FURTHEST_M))
    indices = used[_first_of_each_cube(b.xyz_m[used])]
    after_s = _offsets_s(b, rig.sweep_b)[indices] + (b.stamp_ns - a.stamp_ns) * 1e-9
    return Cloud(a_m, np.ascontiguousarray(b.xyz_m[indices]), after_s, pair.motion, rig.T_a_ego)


def _offsets_s(sweep: LidarFrame, timing: SweepTiming | None) -> DoublesOfSweeps:
    if sweep.time_offset_s is not None:
        return sweep.time_offset_s.astype(np.float64)
    return np.zeros(len(sweep.xyz_m)) if timing is None else azimuth_offsets_s(sweep.xyz_m, timing)


def _at(
    xyz_m: NDArray[np.float32], after_s: DoublesOfSweeps, motion: EgoMotion | None, T_lidar_ego: Matrix4
) -> DoublesOfSweeps:
    if motion is None:
        return xyz_m.astype(np.float64)
    angular, linear = sensor_twist(motion, T_lidar_ego)
    return deskew(xyz_m, after_s, angular, linear).astype(np.float64)


def _first_of_each_cube(points_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """Indices of the first point in each cube, ascending."""
    cubes = np.floor(points_m / THINNED_M).astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    return np.sort(first)
