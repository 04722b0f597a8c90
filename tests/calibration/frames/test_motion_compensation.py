"""Motion compensation: points seen from a moving sensor land where a standing one would have seen them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate, compensation
from coec.calibration.frames.pairing import azimuth_offsets_s
from coec.calibration.types import Compensation, EgoMotion, FramePair, SweepTiming, Window
from coec.geometry import se3
from coec.geometry.sweep_kernels import deskew

TWIST = np.array([0.02, -0.05, 0.4, 9.0, 0.5, -0.1])
"""A sharp turn at 9 m/s: rad/s and m/s."""


def test_deskew_is_the_exponential_of_the_twist(rng: np.random.Generator) -> None:
    xyz = rng.normal(scale=20.0, size=(50, 3)).astype(np.float32)
    dt = rng.uniform(-0.1, 0.1, 50)
    expected = [(se3.exp(TWIST * t) @ [*p, 1.0])[:3] for p, t in zip(xyz.astype(float), dt, strict=True)]
    np.testing.assert_allclose(deskew(xyz, dt, TWIST[:3], TWIST[3:]), expected, atol=1e-5)


@pytest.mark.parametrize("rate", [0.0, 1e-9, 1e-5, 3e-3, 0.199, 0.201, 1.0])
def test_deskew_is_smooth_where_the_series_takes_over(rate: float) -> None:
    twist = np.array([0.0, 0.0, rate, 10.0, 0.0, 0.0])
    point = np.array([[30.0, 5.0, 1.0]], np.float32)
    expected = (se3.exp(twist * 0.05) @ [30.0, 5.0, 1.0, 1.0])[:3]
    np.testing.assert_allclose(deskew(point, np.array([0.05]), twist[:3], twist[3:])[0], expected, atol=1e-5)


def test_a_wall_seen_while_driving_at_it_is_flat_again(street: Window) -> None:
    """A point measured t after the exposure is nearer by v·t; compensation puts it back to where it was then."""
    t = np.linspace(-0.05, 0.05, 101, dtype=np.float32)
    seen = np.column_stack([20.0 - 10.0 * t, np.linspace(-3, 3, 101), np.zeros(101)]).astype(np.float32)
    lidar = replace(street.pairs[0].lidar, stamp_ns=0, xyz_m=seen, time_offset_s=t, intensity=None, ring=None)
    camera = replace(street.pairs[0].camera, stamp_ns=0)
    motion = EgoMotion(0, "ego", (10.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    rig = replace(street.rig, T_lidar_ego=np.eye(4))
    xyz_m = compensate(FramePair(camera, lidar, motion), rig, enabled=True)
    np.testing.assert_allclose(xyz_m[:, 0], 20.0, atol=1e-5)


def test_the_stamps_of_camera_and_sweep_may_differ(street: Window) -> None:
    lidar = replace(
        street.pairs[0].lidar, stamp_ns=20_000_000, xyz_m=np.array([[10, 0, 0]], np.float32),
        time_offset_s=np.zeros(1, np.float32), intensity=None, ring=None,
    )  # fmt: skip
    camera = replace(street.pairs[0].camera, stamp_ns=0)
    rig = replace(street.rig, T_lidar_ego=np.eye(4))
    motion = EgoMotion(0, "ego", (10.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert compensate(FramePair(camera, lidar, motion), rig, enabled=True)[0, 0] == pytest.approx(10.2)


def test_the_lever_arm_turns_rotation_into_velocity(street: Window) -> None:
    """A LiDAR two metres ahead of a turning axle moves sideways."""
    lever = np.eye(4)
    lever[0, 3] = -2.0  # the ego origin lies two metres behind the LiDAR
    rig = replace(street.rig, T_lidar_ego=lever)
    lidar = replace(
        street.pairs[0].lidar, stamp_ns=100_000_000, xyz_m=np.zeros((1, 3), np.float32),
        time_offset_s=np.zeros(1, np.float32), intensity=None, ring=None,
    )  # fmt: skip
    camera = replace(street.pairs[0].camera, stamp_ns=0)
    motion = EgoMotion(0, "ego", (0.0, 0.0, 0.0), (0.0, 0.0, 0.1))
    moved = compensate(FramePair(camera, lidar, motion), rig, enabled=True)[0]
    np.testing.assert_allclose(moved, [0.0, 0.02, 0.0], atol=2e-4)


def test_where_only_the_turn_is_known_points_are_turned_about_the_lidar_and_not_shifted(street: Window) -> None:
    """Whatever the lever arm: nobody knows how fast the LiDAR moved."""
    mounted = replace(street.rig, T_lidar_ego=se3.transform_from(np.eye(3), np.array([0.0, -3.0, 1.0])))
    lidar = replace(
        street.pairs[0].lidar, stamp_ns=0, xyz_m=np.array([[10.0, 0.0, 0.0]], np.float32),
        time_offset_s=np.array([0.1], np.float32), intensity=None, ring=None,
    )  # fmt: skip
    motion = EgoMotion(0, "imu", None, (0.0, 0.0, 0.5))
    moved = compensate(FramePair(replace(street.pairs[0].camera, stamp_ns=0), lidar, motion), mounted, enabled=True)
    np.testing.assert_allclose(moved, [[10 * np.cos(0.05), 10 * np.sin(0.05), 0.0]], atol=1e-5)


@pytest.mark.parametrize(
    ("azimuth_deg", "offset_s"), [(0, 0.0), (90, -0.025), (-90, 0.025), (179, -0.0497), (-179, 0.0497)]
)
def test_clockwise_sweep_stamped_ahead(azimuth_deg: float, offset_s: float) -> None:
    """KITTI's HDL-64: a point to the left was taken before the beam looked ahead (METHOD, section 3)."""
    a = np.deg2rad(azimuth_deg)
    point = np.array([[np.cos(a), np.sin(a), 0.0]], np.float32)
    assert azimuth_offsets_s(point, SweepTiming(0.1, -1))[0] == pytest.approx(offset_s, abs=1e-4)


def test_each_reason_for_not_compensating_is_reported(street: Window) -> None:
    pair = street.pairs[0]
    timeless = replace(pair.lidar, time_offset_s=None)
    cases: list[tuple[FramePair, bool, Compensation]] = [
        (pair, True, Compensation.DONE),
        (replace(pair, motion=None), True, Compensation.NO_EGO_MOTION),
        (replace(pair, lidar=timeless), True, Compensation.NO_POINT_TIME),
        (pair, False, Compensation.DISABLED),
        (replace(pair, motion=EgoMotion(0, "imu", None, (0.0, 0.0, 0.1))), True, Compensation.ROTATION_ONLY),
    ]
    rig = replace(street.rig, sweep=None)
    for given, enabled, expected in cases:
        assert compensation(given, rig, enabled=enabled) is expected


def test_there_and_back_again(rng: np.random.Generator) -> None:
    xyz: NDArray[np.float32] = rng.normal(scale=20.0, size=(200, 3)).astype(np.float32)
    dt = np.full(200, 0.07)
    there = deskew(xyz, dt, TWIST[:3], TWIST[3:])
    np.testing.assert_allclose(deskew(there, -dt, TWIST[:3], TWIST[3:]), xyz, atol=1e-4)
