"""Windows of a small drive, with the results that a vehicle left in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coec.adapters.depth.maps import open_depth
from coec.adapters.files.conversions import result_of
from coec.adapters.images.codec import GreyImages
from coec.adapters.mcap.windows import WindowWriter, read_window, write_result
from coec.calibration.calibrator import calibrate
from coec.calibration.ports import Silence
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, ObjectiveConfig
from coec.sources import windows
from drives import rendered_drive

SMALL_DRIVE = "sim:seed=1&seconds=12&camera_hz=0.5&lidar_hz=0.5&camera=fisheye160&lidar=16&depth=yes"
"""Six frames, two seconds apart, with exact depth."""

LIMITS = LimitsConfig()
WINDOW_CONFIGURATION = CalibrationConfig(
    depth=DepthConfig(model="stereo"), objective=ObjectiveConfig(kind="mi", depth_bins=24, range_bins=20)
)
"""Quick, and not the defaults: what a file says must be used."""

STARTS_RAD = {"one": (0.02, -0.01, 0.01), "two": (0.0, 0.015, -0.01)}
"""By the vehicle that recorded the window: how far off it began."""


def recorded_windows(folder: Path) -> Path:
    """The folder, with two windows in it, as the services of two vehicles leave them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coec.simulation.source.open_sim", rendered_drive)
        loaded = windows.load_window(SMALL_DRIVE, None, 25, lambda *_: None)
    for vehicle, start in STARTS_RAD.items():
        window = windows.with_perturbed_start(loaded.window, np.array([*start, 0, 0, 0]))
        window = replace(window, window_id=f"{vehicle}-1")
        path = folder / vehicle / f"{window.window_id}.mcap"
        path.parent.mkdir()
        writer = WindowWriter(
            path, window.rig, window.T_camera_lidar_start, window.window_id, WINDOW_CONFIGURATION, {"vehicle": vehicle}
        )
        for pair in window.pairs:
            writer.add(pair)
        writer.finish()
        read, configuration = read_window(path)
        depth = open_depth(configuration.depth, LIMITS)
        estimate = calibrate(read, depth, GreyImages(LIMITS), configuration, Silence())
        write_result(path, result_of(estimate, read.rig, vehicle))
    return folder
