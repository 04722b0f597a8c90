"""The clock of the camera against that of the LiDAR: seen in turns, and only there."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, radians
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.conftest import window_of
from coec.calibration.frames.time_offset import TimeOffset, estimate_time_offset
from coec.calibration.types import Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry import se3
from coec.io.images import GreyImages
from coec.io.recordings.layouts import open_source
from coec.io.recordings.recording_source import parse_spec
from coec_lab.simulation.drive import SimulatedDrive
from coec_lab.simulation.source import open_sim
from support.simulated_drives import rendered_source

CONFIG = CalibrationConfig()
DRIVE = "sim:seed=0&seconds=600&camera_hz=0.5&lidar_hz=0.5&camera=fisheye700&lidar=32"
BENDS = 14
"""Enough frames for the roll, which an offset in a bend could be taken for."""


def turn_rates_radps(drive: SimulatedDrive) -> NDArray[np.float64]:
    """(N,) true turn rate of the vehicle at each camera frame."""
    separation_ns = 10_000_000

    def rate(stamp_ns: int) -> float:
        before, after = drive.true_pose(stamp_ns - separation_ns), drive.true_pose(stamp_ns + separation_ns)
        return float(se3.rotation_log(before[:3, :3].T @ after[:3, :3])[2] / (2e-9 * separation_ns))

    return np.array([rate(stamp_ns) for stamp_ns in drive.camera_stamps_ns])


@pytest.fixture(scope="module")
def in_order_of_turning() -> list[int]:
    """The camera frames of ten minutes, from the sharpest turn to the right to the sharpest to the left."""
    drive = open_sim(parse_spec(DRIVE).query)
    return [int(index) for index in turn_rates_radps(drive).argsort()]


@pytest.fixture(scope="module")
def bends(in_order_of_turning: list[int]) -> Window:
    """The sharpest turns to both sides."""
    sharpest = (*in_order_of_turning[: BENDS // 2], *in_order_of_turning[-BENDS // 2 :])
    return window_of(rendered_source(DRIVE, sharpest))


@pytest.fixture(scope="module")
def straight(in_order_of_turning: list[int]) -> Window:
    """Frames that were taken while the vehicle went straight on."""
    middle = len(in_order_of_turning) // 2
    return window_of(rendered_source(DRIVE, tuple(in_order_of_turning[middle - 3 : middle + 3])))


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
    result = estimate(late(bends, offset_s))
    assert result.observable, result.reason
    assert abs(result.offset_s - offset_s) <= 3.0 * result.sigma_s
    assert result.turn_spread_radps > radians(CONFIG.time_offset.min_turn_spread_deg_per_s)


def test_shifting_the_stamps_shifts_the_offset(bends: Window) -> None:
    """Whatever bias the scene has cancels."""
    moved = estimate(late(bends, 0.05)).offset_s - estimate(bends).offset_s
    assert moved == pytest.approx(0.05, abs=0.002)


def test_a_straight_drive_does_not_show_it(straight: Window) -> None:
    result = estimate(late(straight, 0.04))
    assert not result.observable
    assert "straight" in result.reason


def test_an_offset_beyond_reach_is_not_believed(bends: Window) -> None:
    near = CONFIG.model_copy(update={"time_offset": CONFIG.time_offset.model_copy(update={"reach_s": 0.04})})
    result = estimate(late(bends, 0.09), near)
    assert not result.observable
    assert "bound" in result.reason


def test_what_the_position_of_the_mount_is_not_known_to_goes_into_sigma(bends: Window) -> None:
    vague = CONFIG.time_offset.model_copy(update={"translation_sigma_m": 0.5})
    result = estimate(bends, CONFIG.model_copy(update={"time_offset": vague}))
    assert not result.observable
    assert result.sigma_s > 3.0 * estimate(bends).sigma_s
    assert "known to" in result.reason


def test_without_ego_motion_there_is_nothing_to_see(bends: Window) -> None:
    standing = replace(bends, pairs=tuple(replace(pair, motion=None) for pair in bends.pairs))
    result = estimate(standing)
    assert not result.observable
    assert isnan(result.offset_s)
    assert "ego-motion" in result.reason


def test_without_motion_compensation_there_is_nothing_to_see(bends: Window) -> None:
    result = estimate(bends, CONFIG.model_copy(update={"motion_compensation": False}))
    assert not result.observable
    assert "motion compensation" in result.reason


def test_same_input_same_bits(bends: Window) -> None:
    assert estimate(bends) == estimate(bends)


@pytest.mark.parametrize(
    ("camera", "offset_s"),
    [
        ("image_00", 0.04),
        ("image_01", 0.0),
        pytest.param("image_00", 0.0, marks=pytest.mark.slow),
        pytest.param("image_01", 0.04, marks=pytest.mark.slow),
    ],
)
def test_an_offset_is_recovered_on_a_recording(sample_data: Path, camera: str, offset_s: float) -> None:
    window = window_of(open_source(f"kitti360:{sample_data / 'kitti360'}?camera={camera}"))
    result = estimate(late(window, offset_s))
    assert result.observable, result.reason
    assert abs(result.offset_s - offset_s) <= 3.0 * result.sigma_s
    assert abs(result.offset_s - offset_s) < 0.005


def test_the_straight_part_of_a_recording_does_not_show_it(sample_data: Path) -> None:
    window = window_of(open_source(f"kitti360:{sample_data / 'kitti360'}?camera=image_00"))
    straight = tuple(
        pair for pair in window.pairs if pair.motion is not None and abs(pair.motion.angular_radps[2]) < radians(2.0)
    )
    result = estimate(replace(window, pairs=straight))
    assert len(straight) == 5
    assert not result.observable
    assert "straight" in result.reason
