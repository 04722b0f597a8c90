"""Clouds of several LiDARs in one, told where no field says which point is whose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.lidar_origin import OriginCheck, SeveralOrigins
from coec.calibration.types import LidarFrame
from coec.geometry import se3
from support.scenes import ROOF_POSE, sweep_in_frame, turning_sweep

LEFT = se3.exp(np.array([0.05, 0.0, 1.2, 0.6, 0.9, 1.2]))
RIGHT = se3.exp(np.array([-0.04, 0.02, -1.2, 0.6, -0.9, 1.2]))
HERE = np.eye(4)


def joined(*sweeps: LidarFrame) -> LidarFrame:
    """One behind the other, as those who concatenate clouds do."""
    rings = [sweep.ring for sweep in sweeps if sweep.ring is not None]
    return replace(sweeps[0], xyz_m=np.concatenate([sweep.xyz_m for sweep in sweeps]), ring=np.concatenate(rings))


def thinned(sweep: LidarFrame, share: float) -> LidarFrame:
    """A beginning of it, a part of the turn left out."""
    assert sweep.ring is not None
    count = int(share * len(sweep.xyz_m))
    return replace(sweep, xyz_m=sweep.xyz_m[:count], ring=sweep.ring[:count])


def noisy(seed: int) -> LidarFrame:
    return turning_sweep(seed, noise_rad=np.radians(0.1), walkers=0.1)


@pytest.mark.parametrize(
    "poses", [(ROOF_POSE, LEFT), (LEFT, RIGHT), (HERE, LEFT), (LEFT, HERE), (ROOF_POSE, LEFT, RIGHT)], ids=range(5)
)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_several_lidars_in_one_cloud_are_reported_with_their_places(
    poses: tuple[NDArray[np.float64], ...], seed: int
) -> None:
    result = OriginCheck().inspect(joined(*(sweep_in_frame(noisy(seed + n), T) for n, T in enumerate(poses))))
    assert isinstance(result, SeveralOrigins)
    np.testing.assert_allclose(result.origins_m, [T[:3, 3] for T in poses[:2]], atol=0.15)
    assert "concatenated" in result.sentence


@pytest.mark.parametrize("share", [0.75, 0.5])
def test_a_small_lidar_next_to_the_one_of_the_frame_is_reported(share: float) -> None:
    cloud = joined(turning_sweep(1), thinned(sweep_in_frame(turning_sweep(2), LEFT), share))
    assert isinstance(OriginCheck().inspect(cloud), SeveralOrigins)


def test_rings_of_their_own_numbers_are_reported_too() -> None:
    other = sweep_in_frame(turning_sweep(2), LEFT)
    assert other.ring is not None
    cloud = joined(sweep_in_frame(turning_sweep(1), ROOF_POSE), replace(other, ring=other.ring + np.uint16(16)))
    assert isinstance(OriginCheck().inspect(cloud), SeveralOrigins)


def test_the_next_cloud_is_distinguished_from_what_was_discovered() -> None:
    check = OriginCheck()
    for seed in range(3):
        cloud = joined(sweep_in_frame(noisy(seed), ROOF_POSE), sweep_in_frame(noisy(seed + 7), LEFT))
        assert isinstance(check.inspect(cloud), SeveralOrigins)
    assert check.inspect(turning_sweep()) is None


@pytest.mark.parametrize("walkers", [0.0, 0.2, 0.4])
def test_a_crowd_is_no_second_lidar(walkers: float) -> None:
    assert OriginCheck().inspect(turning_sweep(noise_rad=np.radians(0.1), walkers=walkers)) is None


@pytest.mark.parametrize("speed_mps", [15.0, 25.0, 40.0])
def test_a_lidar_that_drove_on_while_it_turned_is_one(speed_mps: float) -> None:
    """Points that a driver has brought to where the LiDAR was at the end."""
    sweep = turning_sweep(noise_rad=np.radians(0.05))
    ahead_m = speed_mps * np.linspace(-0.1, 0.0, len(sweep.xyz_m), dtype=np.float32)
    moved = sweep.xyz_m + ahead_m[:, None] * np.array([1.0, 0.0, 0.0], np.float32)
    assert not isinstance(OriginCheck().inspect(replace(sweep, xyz_m=moved)), SeveralOrigins)
