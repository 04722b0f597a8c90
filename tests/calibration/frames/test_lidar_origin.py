"""Points that were measured from elsewhere than their frame's origin: taken back, or told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.lidar_origin import GIVE_UP, ApparentOrigin, OriginCheck, from_origin
from coec.calibration.types import LidarFrame
from coec.geometry import se3
from support.scenes import ROOF_POSE, TILTED_ROOF_POSE, sweep_in_frame, turning_sweep


@pytest.mark.parametrize("T", [ROOF_POSE, TILTED_ROOF_POSE])
def test_points_are_taken_back_to_where_they_were_measured_from(T: NDArray[np.float64]) -> None:
    back = from_origin(sweep_in_frame(turning_sweep(), T), T, "lidar")
    assert back.frame_id == "lidar"
    np.testing.assert_allclose(back.xyz_m, turning_sweep().xyz_m, atol=1e-5)


def test_without_a_pose_the_points_stay_as_they_are_to_the_bit() -> None:
    sweep = turning_sweep()
    assert from_origin(sweep, np.eye(4), "lidar").xyz_m is sweep.xyz_m


@pytest.mark.parametrize("noise_deg", [0.0, 0.1])
@pytest.mark.parametrize("walkers", [0.0, 0.2])
def test_a_right_origin_is_not_contradicted(noise_deg: float, walkers: float) -> None:
    assert OriginCheck().inspect(turning_sweep(noise_rad=np.radians(noise_deg), walkers=walkers)) is None


@pytest.mark.parametrize("T", [ROOF_POSE, TILTED_ROOF_POSE])
@pytest.mark.parametrize(("noise_deg", "walkers"), [(0.0, 0.0), (0.1, 0.2)])
def test_a_wrong_origin_is_reported_with_the_right_one(
    T: NDArray[np.float64], noise_deg: float, walkers: float
) -> None:
    result = OriginCheck().inspect(sweep_in_frame(turning_sweep(noise_rad=np.radians(noise_deg), walkers=walkers), T))
    assert isinstance(result, ApparentOrigin)
    np.testing.assert_allclose(result.origin_m, T[:3, 3], atol=0.1)
    assert "look as if measured from (+1." in result.sentence


def test_a_turned_frame_is_no_wrong_origin() -> None:
    T = se3.exp(np.array([0.1, 0.15, 0.4, 0.0, 0.0, 0.0]))
    assert OriginCheck().inspect(sweep_in_frame(turning_sweep(), T)) is None


def numbered(sweep: LidarFrame, ring: NDArray[np.integer] | None) -> LidarFrame:
    return replace(sweep, ring=None if ring is None else ring.astype(np.uint16))


@pytest.mark.parametrize("kind", ["none", "constant", "random"])
def test_where_rings_are_none_nothing_is_reported(kind: str) -> None:
    sweep = sweep_in_frame(turning_sweep(), ROOF_POSE)
    count = len(sweep.xyz_m)
    ring = {"none": None, "constant": np.zeros(count, int), "random": np.random.default_rng(0).integers(0, 64, count)}
    assert OriginCheck().inspect(numbered(sweep, ring[kind])) is None


def test_a_check_gives_up_where_no_cones_explain_the_rings() -> None:
    check, moved = OriginCheck(), sweep_in_frame(turning_sweep(), ROOF_POSE)
    strange = numbered(moved, np.random.default_rng(0).integers(0, 64, len(moved.xyz_m)))
    strange = replace(strange, xyz_m=strange.xyz_m[::4], ring=None if strange.ring is None else strange.ring[::4])
    for _ in range(GIVE_UP):
        assert check.inspect(strange) is None
    assert check.inspect(moved) is None


def test_the_next_sweep_is_reported_too() -> None:
    check = OriginCheck()
    for seed in range(3):
        assert check.inspect(sweep_in_frame(turning_sweep(seed), ROOF_POSE)) is not None
    assert check.inspect(turning_sweep()) is None


@pytest.mark.parametrize("points", [0, 1, 11])
def test_too_few_points_say_nothing(points: int) -> None:
    sweep = sweep_in_frame(turning_sweep(), ROOF_POSE)
    assert sweep.ring is not None
    assert OriginCheck().inspect(replace(sweep, xyz_m=sweep.xyz_m[:points], ring=sweep.ring[:points])) is None
