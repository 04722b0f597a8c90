"""Numbers in the field that is read as ring: scan lines only if the points of a number lie at one elevation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.lidar_origin import NO_SCAN_LINES, OriginCheck
from coec.calibration.types import LidarFrame
from coec.geometry import se3
from coec.io.recordings.cloud_files import measured_from
from coec.io.recordings.layouts import open_source
from support.scenes import ROOF_POSE, sweep_in_frame, turning_sweep


def read(sweep: LidarFrame) -> LidarFrame:
    return measured_from(sweep, np.eye(4), "lidar", Path("cloud"), {"cloud_origin": "", "cloud_concatenated": ""})


def numbered(sweep: LidarFrame, ring: NDArray[np.integer]) -> LidarFrame:
    return replace(sweep, ring=ring.astype(np.uint16))


def test_the_beams_of_a_turning_lidar_are_scan_lines() -> None:
    for sweep in (turning_sweep(), turning_sweep(noise_rad=np.radians(0.1), walkers=0.2)):
        assert read(sweep).ring is sweep.ring
        assert read(sweep).recognitions == ()


def test_the_beams_of_a_tilted_lidar_are_scan_lines() -> None:
    sweep = sweep_in_frame(turning_sweep(), se3.exp(np.array([0.3, 0.15, 0.4, 0.0, 0.0, 0.0])))
    assert read(sweep).ring is not None


@pytest.mark.parametrize("layers", [2, 4])
def test_a_few_layers_are_scan_lines(layers: int) -> None:
    sweep = turning_sweep()
    assert sweep.ring is not None
    selected = np.isin(sweep.ring, np.arange(layers) + 6)
    few = replace(sweep, xyz_m=sweep.xyz_m[selected], ring=sweep.ring[selected])
    assert read(few).ring is not None


@pytest.mark.parametrize("lasers", [2, 4, 6])
def test_lasers_that_fire_in_turn_along_a_rosette_are_no_scan_lines(lasers: int) -> None:
    sweep = turning_sweep()
    order = np.random.default_rng(0).permutation(len(sweep.xyz_m))
    result = read(numbered(replace(sweep, xyz_m=sweep.xyz_m[order]), np.arange(len(order)) % lasers))
    assert result.ring is None
    assert result.recognitions == (NO_SCAN_LINES,)


@pytest.mark.parametrize("zones", [5, 8])
def test_zones_of_azimuth_are_no_scan_lines_and_contradict_no_origin(zones: int) -> None:
    sweep = turning_sweep()
    x_m, y_m, _ = sweep.xyz_m.T
    ahead = np.abs(np.arctan2(y_m, x_m)) < 1.0
    sweep = replace(sweep, xyz_m=sweep.xyz_m[ahead], ring=None)
    azimuth = np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0])
    zone = np.digitize(azimuth, np.quantile(azimuth, np.arange(1, zones) / zones))
    assert read(numbered(sweep, zone)).ring is None


def test_scan_lines_that_were_measured_from_elsewhere_stay_scan_lines() -> None:
    check, sweep = OriginCheck(), sweep_in_frame(turning_sweep(), ROOF_POSE)
    assert check.inspect(sweep) is not None
    assert check.has_scan_lines(sweep)


def test_one_number_for_all_points_is_left_to_the_reader() -> None:
    sweep = turning_sweep()
    assert read(numbered(sweep, np.zeros(len(sweep.xyz_m), int))).ring is not None


@pytest.mark.parametrize(
    "folder", ["fisheye_garage", "fisheye_lab_vlp16", "tamu_right_os", "tamu_right_vlp", "yoco_fisheye_bpearl"]
)
def test_real_rings_are_scan_lines(folder: str, sample_data: Path) -> None:
    sweeps = (m for m in open_source(str(sample_data / folder)).messages() if isinstance(m, LidarFrame))
    assert next(sweeps).ring is not None
