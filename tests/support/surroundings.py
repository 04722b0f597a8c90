"""Surroundings of a LiDAR, and its sweeps of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import EgoMotion, LidarFrame, Matrix4

Doubles = NDArray[np.float64]

NOISE_M = 0.02


Shape = Callable[[np.random.Generator, int], Doubles]


def room(rng: np.random.Generator, count: int) -> Doubles:
    """Points on floor, two walls along x and one across, about the vehicle; world is the ego frame at the instant."""
    part = rng.integers(0, 4, count)
    x, y, z = rng.uniform(-4, 4, count), rng.uniform(-3, 3, count), rng.uniform(0, 2.5, count)
    floor = np.column_stack([x, y, np.zeros(count)])
    left = np.column_stack([x, np.full(count, 3.0), z])
    right = np.column_stack([x, np.full(count, -3.0), z])
    end = np.column_stack([np.full(count, 4.0), y, z])
    return np.choose(part[:, None], [floor, left, right, end])


def corridor(rng: np.random.Generator, count: int) -> Doubles:
    """The same without the wall across: nothing tells how far along it anybody is."""
    points = room(rng, count)
    across = points[:, 0] == 4.0
    points[across] = np.column_stack(
        [rng.uniform(-4, 4, across.sum()), np.full(across.sum(), 3.0), rng.uniform(0, 2.5, across.sum())]
    )
    return points


def sweep(
    points_m: Doubles, T_lidar_ego: Matrix4, name: str, rng: np.random.Generator, *, longer_m: float = 0.0,
    after_s: Doubles | None = None, motion: EgoMotion | None = None, stamp_ns: int = 0,
) -> LidarFrame:  # fmt: skip
    """Points (N, 3) of the ego frame at the instant 0, as a LiDAR measures them, each `after_s` later."""
    local = points_m @ T_lidar_ego[:3, :3].T + T_lidar_ego[:3, 3]
    if after_s is not None and motion is not None:
        assert motion.linear_mps is not None
        # Most points have an instant of their own: the motion of each is exp(-twist * seconds), written out.
        turn, way = np.array(motion.angular_radps), -np.multiply.outer(after_s, motion.linear_mps)
        axis = turn / max(float(np.linalg.norm(turn)), 1e-12)
        angle = -after_s[:, None] * np.linalg.norm(turn)
        share = np.sinc(angle / np.pi)  # of the chord in the arc
        drop = (1.0 - np.cos(angle)) / np.where(angle == 0.0, 1.0, angle)
        turned = points_m * np.cos(angle) + np.cross(axis, points_m) * np.sin(angle)
        turned += axis * (points_m @ axis)[:, None] * (1.0 - np.cos(angle))
        moved = way * share + np.cross(axis, way) * drop + axis * (way @ axis)[:, None] * (1.0 - share)
        local = (turned + moved) @ T_lidar_ego[:3, :3].T + T_lidar_ego[:3, 3]
    range_m = np.linalg.norm(local, axis=1, keepdims=True)
    local *= (range_m + longer_m + rng.normal(0, NOISE_M, range_m.shape)) / range_m
    offsets = None if after_s is None else (after_s - stamp_ns * 1e-9).astype(np.float32)
    return LidarFrame(stamp_ns, name, local.astype(np.float32), time_offset_s=offsets)
