"""Windows as a vehicle records them, with the decision that they got."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

import coec
from coec.calibration.pipeline import calibrate
from coec.calibration.types import Silence
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, ObjectiveConfig, SearchConfig
from coec.geometry import se3
from coec.io.depth.depth_maps import open_depth
from coec.io.images import GreyImages
from coec.io.mcap.windows import WindowWriter, read_window, write_result
from coec.io.serialise import result_of
from golden.reference import DATA, plain
from golden.scene import Drive, write

FILE = DATA / "recorded.json"
LIMITS = LimitsConfig()
STEREO = DepthConfig(model="stereo")
START = np.array([*np.radians([-1.5, 1.0, 0.8]), 0.0, 0.0, 0.0])

WINDOWS: Mapping[str, tuple[Drive, CalibrationConfig]] = MappingProxyType(
    {
        "rotation": (
            Drive("double_sphere", pairs=3, beams=10, columns=64, half_view_deg=50.0, depth_step=4),
            CalibrationConfig(depth=STEREO, objective=ObjectiveConfig(kind="mi", depth_bins=24, range_bins=20)),
        ),
        "both": (
            Drive("pinhole", seed=2, pairs=3, beams=12, columns=100, half_view_deg=25.0, depth_step=4),
            CalibrationConfig(depth=STEREO, search=SearchConfig(dof=6, rotation_deg=6.0)),
        ),
    }
)
"""The drive of which a window is recorded, and how it is calibrated."""


def path_of(name: str) -> Path:
    """The file under version control."""
    return DATA / f"{name}.mcap"


def record(name: str, path: Path, folder: Path) -> None:
    """Writes the file of a window, as the service does, into `path`. `folder` is for what it is made of."""
    drive, configuration = WINDOWS[name]
    window = coec.open(write(drive, folder)).window().loaded.window
    start = se3.perturb(window.T_camera_lidar_start, START)
    writer = WindowWriter(path, window.rig, start, window.window_id, configuration, {"vehicle": "shuttle-7"})
    for pair in window.pairs:
        writer.add(pair)
    writer.finish()
    read, settings = read_window(path)
    estimate = calibrate(read, open_depth(settings.depth, LIMITS), GreyImages(LIMITS), settings, Silence())
    write_result(path, result_of(estimate, read.rig, "shuttle-7"))


def content(path: Path) -> Any:
    """Everything that is read of a window, its configuration by its fields."""
    window, configuration = read_window(path)
    return [plain(window), configuration.model_dump(mode="json")]
