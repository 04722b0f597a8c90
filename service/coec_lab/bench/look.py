"""Processor time of a look of the monitor: six pairs of a simulated street, from bytes to the verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from math import degrees
from typing import Any

import numpy as np

from coec.adapters.depth.maps import open_depth
from coec.adapters.images.codec import CachedGreys, GreyImages
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.check_verdict import observe
from coec.calibration.types import Window
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig
from coec.sources import windows

PAIRS = 6
"""Pairs of a look: the default of the monitor."""

DRIVE = f"seed=930001&seconds={PAIRS + 0.5}&camera_hz=1&lidar_hz=1&ego_hz=10&lidar=64&depth=yes"
"""One pair per second, with a LiDAR of 64 beams: at least 110,000 points per sweep."""

SIDES_PX: Mapping[str, str] = {"1400": "fisheye1400", "700": "fisheye700"}
"""Cameras, by the side of their images."""

REPEATS = 12
"""Looks of which the fastest counts, because other load on the caches only makes looks slower."""


def measure(heard: Callable[[str], None]) -> dict[str, Any]:
    """By the side of the images: the least processor time of all threads for a look at the right pose, ms, and how far
    off the truth the look puts the mount, degrees. A look that is flagged, faint or blind gets no time, because it is
    not the look that should be measured."""
    spent: dict[str, float | None] = {}
    off_deg: dict[str, float] = {}
    for side, camera in SIDES_PX.items():
        heard(f"a look at {side} px")
        window = windows.load(f"sim:{DRIVE}&camera={camera}", None, PAIRS, lambda *_: None).window
        spent_s, told = _look(window)
        right = not (told.flagged or told.weak or told.causes)
        spent[side] = 1e3 * spent_s if right else None
        off_deg[side] = degrees(float(np.linalg.norm(told.offset[:3])))
    return {f"look_{side}_cpu_ms": figure for side, figure in spent.items()} | {"look_off_deg": off_deg}


def _look(window: Window) -> tuple[float, Observation]:
    """Looks as the worker does: images are decoded once per look, and nothing is kept from the look before. The first
    run on a machine compiles."""
    configuration, limits = CalibrationConfig(depth=DepthConfig(model="stereo")), LimitsConfig()
    depth, least_s = open_depth(configuration.depth, limits), float("inf")
    for _ in range(1 + REPEATS):
        begin = time.process_time()
        told = observe(window, depth, CachedGreys(GreyImages(limits), len(window.pairs)), configuration, None)
        least_s = min(least_s, time.process_time() - begin)
    return least_s, told
