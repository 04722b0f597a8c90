"""The clock of the camera against that of the LiDAR: seen in turns, and only there."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, radians
from pathlib import Path

import numpy as np
import pytest

from calibration.conftest import pairs_of
from coec.adapters.images.codec import GreyImages
from coec.calibration.frames.time_offset import TimeOffset, estimate_time_offset
from coec.calibration.types import Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry import se3

CONFIG = CalibrationConfig()
STEADY = "synthetic:?seed=3&frames=6&width=640&period_s=8.571428571"
"""A frame at the same place of every bend, where the vehicle goes straight on: one wavelength of 60 m at 7 m/s."""


@pytest.fixture(scope="module")
def bends() -> Window:
    """Enough frames for the roll, which an offset in a bend could be taken for."""
    return pairs_of("synthetic:?seed=3&frames=14&width=800")[1]


def late(window: Window, offset_s: float) -> Window:
    """The window of a camera that was exposed so much later than its stamps say."""
    offset_ns = round(offset_s * 1e9)
    pairs = [
        replace(pair, camera=replace(pair.camera, stamp_ns=pair.camera.stamp_ns - offset_ns)) for pair in window.pairs
    ]
    return replace(window, pairs=tuple(pairs))


def estimate(window: Window, config: CalibrationConfig = CONFIG) -> TimeOffset:
    """From a pose that is off by what an offset puts into it."""
    pose = se3.perturb(window.T_camera_lidar_start, np.array([0.003, -0.004, 0.002, 0.0, 0.0, 0.0]))
    return estimate_time_offset(window, GreyImages(LimitsConfig()), pose, config)


@pytest.mark.parametrize("offset_s", [0.0, 0.04, -0.03])
def test_an_offset_is_recovered_in_bends(bends: Window, offset_s: float) -> None:
    found = estimate(late(bends, offset_s))
    assert found.observable, found.reason
    assert abs(found.offset_s - offset_s) <= 3.0 * found.sigma_s
    assert found.turn_spread_radps > radians(CONFIG.time_offset.min_turn_spread_deg_per_s)


def test_shifting_the_stamps_shifts_the_offset(bends: Window) -> None:
    """Whatever bias the scene has cancels."""
    moved = estimate(late(bends, 0.05)).offset_s - estimate(bends).offset_s
    assert moved == pytest.approx(0.05, abs=0.002)


def test_a_straight_drive_does_not_show_it() -> None:
    found = estimate(late(pairs_of(STEADY)[1], 0.04))
    assert not found.observable
    assert "straight" in found.reason


def test_an_offset_beyond_reach_is_not_believed(bends: Window) -> None:
    near = CONFIG.model_copy(update={"time_offset": CONFIG.time_offset.model_copy(update={"reach_s": 0.04})})
    found = estimate(late(bends, 0.09), near)
    assert not found.observable
    assert "bound" in found.reason


def test_what_the_position_of_the_mount_is_not_known_to_goes_into_sigma(bends: Window) -> None:
    vague = CONFIG.time_offset.model_copy(update={"translation_sigma_m": 0.5})
    found = estimate(bends, CONFIG.model_copy(update={"time_offset": vague}))
    assert not found.observable
    assert found.sigma_s > 3.0 * estimate(bends).sigma_s
    assert "known to" in found.reason


def test_without_ego_motion_there_is_nothing_to_see(bends: Window) -> None:
    standing = replace(bends, pairs=tuple(replace(pair, motion=None) for pair in bends.pairs))
    found = estimate(standing)
    assert not found.observable
    assert isnan(found.offset_s)
    assert "ego-motion" in found.reason


def test_without_motion_compensation_there_is_nothing_to_see(bends: Window) -> None:
    found = estimate(bends, CONFIG.model_copy(update={"motion_compensation": False}))
    assert not found.observable
    assert "motion compensation" in found.reason


def test_same_input_same_bits(bends: Window) -> None:
    assert estimate(bends) == estimate(bends)


@pytest.mark.parametrize("camera", ["image_00", "image_01"])
@pytest.mark.parametrize("offset_s", [0.0, 0.04])
def test_an_offset_is_recovered_on_a_recording(sample_data: Path, camera: str, offset_s: float) -> None:
    window = pairs_of(f"kitti360:{sample_data / 'kitti360'}?camera={camera}")[1]
    found = estimate(late(window, offset_s))
    assert found.observable, found.reason
    assert abs(found.offset_s - offset_s) <= 3.0 * found.sigma_s
    assert abs(found.offset_s - offset_s) < 0.005


def test_the_straight_part_of_a_recording_does_not_show_it(sample_data: Path) -> None:
    window = pairs_of(f"kitti360:{sample_data / 'kitti360'}?camera=image_00")[1]
    straight = tuple(
        pair for pair in window.pairs if pair.motion is not None and abs(pair.motion.angular_radps[2]) < radians(2.0)
    )
    found = estimate(replace(window, pairs=straight))
    assert len(straight) == 5
    assert not found.observable
    assert "straight" in found.reason
