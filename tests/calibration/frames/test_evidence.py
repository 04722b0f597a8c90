"""Points that were compensated before they were recorded, and clouds that are parts of a turn, by the points alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.evidence import compensated_for, instants_s, stands
from coec.calibration.frames.message_evidence import clouds_in_turn, sectors
from coec.calibration.frames.motion_compensation import sensor_twist
from coec.calibration.types import EgoMotion, LidarFrame
from coec.geometry import se3
from coec.geometry.sweep_kernels import deskew
from support.scenes import turning_sweep

T_LIDAR_EGO = se3.exp(np.array([0.0, 0.05, 0.4, -1.2, 0.3, -1.6]))
PERIOD_S = 0.1


def timed(seed: int, stamp_share: float = 0.5, noise_m: float = 0.0) -> LidarFrame:
    """A sweep with times; the stamp lies that share of the turn after its begin."""
    sweep = turning_sweep(seed)
    rng = np.random.default_rng(seed)
    x_m, y_m, _ = sweep.xyz_m.T
    times_s = PERIOD_S * (np.arctan2(y_m, x_m) / (2 * np.pi) + 0.5 - stamp_share)
    scale = 1.0 + rng.normal(0.0, noise_m, (len(x_m), 1)) / np.linalg.norm(sweep.xyz_m, axis=1, keepdims=True)
    return replace(sweep, xyz_m=(sweep.xyz_m * scale).astype(np.float32), time_offset_s=times_s.astype(np.float32))


def motion(speed_mps: float = 8.0) -> EgoMotion:
    return EgoMotion(5, "ego", (speed_mps, 0.1, 0.0), (0.0, 0.01, 0.1))


def drive(instant: str | None, speed_mps: float = 8.0, **options: float) -> list[tuple[LidarFrame, EgoMotion]]:
    """Sweeps that a driver compensated for an instant."""
    pairs = []
    for seed in range(4):
        sweep = timed(seed, **options)
        if instant is not None:
            assert sweep.time_offset_s is not None
            dt_s = sweep.time_offset_s.astype(np.float64) - instants_s(sweep)[instant]
            xyz_m = deskew(sweep.xyz_m, dt_s, *sensor_twist(motion(speed_mps), T_LIDAR_EGO))
            sweep = replace(sweep, xyz_m=xyz_m)
        pairs.append((sweep, motion(speed_mps)))
    return pairs


@pytest.mark.parametrize("noise_m", [0.0, 0.03])
@pytest.mark.parametrize("instant", ["stamp", "begin", "end"])
def test_compensated_points_are_recognised_with_their_instant(instant: str, noise_m: float) -> None:
    assert compensated_for(drive(instant, noise_m=noise_m, stamp_share=0.3), T_LIDAR_EGO) == instant


@pytest.mark.parametrize("noise_m", [0.0, 0.03])
@pytest.mark.parametrize("stamp_share", [0.0, 0.5, 1.0])
def test_points_as_measured_are_not(stamp_share: float, noise_m: float) -> None:
    assert compensated_for(drive(None, noise_m=noise_m, stamp_share=stamp_share), T_LIDAR_EGO) is None


def test_without_rings_too() -> None:
    for instant in ("stamp", None):
        pairs = [(replace(sweep, ring=None), moved) for sweep, moved in drive(instant)]
        assert compensated_for(pairs, T_LIDAR_EGO) == instant


def test_nothing_is_known_of_a_standing_vehicle_few_sweeps_or_points_without_times() -> None:
    assert compensated_for(drive("stamp", speed_mps=1.0), T_LIDAR_EGO) is None
    assert compensated_for(drive("stamp")[:2], T_LIDAR_EGO) is None
    assert compensated_for([], T_LIDAR_EGO) is None
    untimed = [(replace(sweep, time_offset_s=None), moved) for sweep, moved in drive("stamp")]
    assert compensated_for(untimed, T_LIDAR_EGO) is None
    turning_only = [(sweep, replace(moved, linear_mps=None)) for sweep, moved in drive("stamp")]
    assert compensated_for(turning_only, T_LIDAR_EGO) is None


def test_a_lidar_that_does_not_turn_shows_nothing() -> None:
    pairs = []
    for sweep, moved in drive(None):
        rng = np.random.default_rng(1)
        times_s = rng.uniform(-0.05, 0.05, len(sweep.xyz_m)).astype(np.float32)
        pairs.append((replace(sweep, ring=None, time_offset_s=times_s), moved))
    assert compensated_for(pairs, T_LIDAR_EGO) is None


def covered(begin_deg: float, width_deg: float) -> NDArray[np.bool_]:
    angle = np.radians(begin_deg + np.linspace(0.0, width_deg, 200, endpoint=False))
    points = np.stack([10 * np.cos(angle), 10 * np.sin(angle), 0 * angle], axis=1).astype(np.float32)
    return sectors(LidarFrame(1, "lidar", points))


@pytest.mark.parametrize("parts", [2, 3, 4, 8, 12])
def test_parts_of_a_turn_are_counted(parts: int) -> None:
    assert clouds_in_turn([covered(7.0 + k * 360 / parts, 360 / parts) for k in range(4 * parts)]) == parts


def test_parts_of_a_turn_that_do_not_divide_it() -> None:
    assert clouds_in_turn([covered(3.0 + 100.0 * k, 100.0) for k in range(24)]) == 4


@pytest.mark.parametrize("width_deg", [70.0, 120.0, 360.0])
def test_a_fixed_view_is_no_part(width_deg: float) -> None:
    rng = np.random.default_rng(0)
    assert clouds_in_turn([covered(rng.normal(-35.0, 1.0), width_deg) for _ in range(24)]) == 1
    assert clouds_in_turn([]) == 1
    assert clouds_in_turn([covered(0.0, width_deg)]) == 1


def seen_from(places_m: NDArray[np.float64], rng: np.random.Generator) -> list[LidarFrame]:
    """Sweeps of a wood on flat ground from some places (N, 3), with somebody who walks about at two metres."""
    trees = rng.uniform((-40.0, -40.0, -2.0), (40.0, 40.0, 8.0), (6_000, 3))
    trees = trees[np.hypot(trees[:, 0], trees[:, 1]) > 3.0]
    elevation, azimuth = np.radians(np.mgrid[-24.5:-5.0:1.0, 0.25:360.0:0.5]).reshape(2, -1)
    ground = (
        np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1) * (-2.0 / np.tan(elevation))[:, None]
    )
    sweeps = []
    for place_m in places_m:
        angle = 2.0 * np.pi * rng.random()
        somebody = rng.uniform(-1.0, 1.0, (400, 3)) * (0.3, 0.3, 1.0) + (2.0 * np.cos(angle), 2.0 * np.sin(angle), 0.0)
        xyz_m = np.concatenate([trees - place_m, ground, somebody])
        xyz_m *= 1.0 + rng.normal(0.0, 0.02, (len(xyz_m), 1)) / np.linalg.norm(xyz_m, axis=1, keepdims=True)
        sweeps.append(LidarFrame(0, "lidar", xyz_m.astype(np.float32)))
    return sweeps


@pytest.mark.parametrize("seed", range(3))
def test_people_before_a_standing_vehicle_do_not_make_it_move(seed: int) -> None:
    assert stands(seen_from(np.zeros((6, 3)), np.random.default_rng(seed)))


@pytest.mark.parametrize("seed", range(3))
def test_a_vehicle_that_moves_does_not_stand_though_the_ground_is_the_same_everywhere(seed: int) -> None:
    assert not stands(seen_from(np.arange(6)[:, None] * np.array([1.5, 0.2, 0.0]), np.random.default_rng(seed)))


def test_sweeps_without_points_show_no_standing_vehicle() -> None:
    empty = LidarFrame(0, "lidar", np.zeros((0, 3), np.float32))
    assert not stands([])
    assert not stands([empty])
    assert not stands([empty, empty])
