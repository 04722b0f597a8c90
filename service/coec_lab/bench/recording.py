"""Processor time of writing windows: encoding, lz4, checksums, digest, and the disk."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from coec.adapters.mcap.windows import WindowWriter
from coec.calibration.types import FramePair
from coec.config import CalibrationConfig, StateConfig
from coec.runtime.ingest.frame_budget import frame_bytes
from coec_lab.bench import scene

RATE_BYTES_PER_S = 35e6
"""A camera of half a megabyte and a LiDAR of three at 10 Hz, every frame written."""

PAIRS, WINDOWS = 25, 6
"""Pairs of a window, and number of windows, of which the fastest counts."""


def measure(heard: Callable[[str], None]) -> dict[str, float]:
    """Percent of a core that the recorder takes at `RATE_BYTES_PER_S` of frames, with its default packing."""
    heard("writing windows")
    camera = scene.CAMERAS["double_sphere"]
    rig = scene.rig_of(camera)
    pairs = [_in_millimetres(scene.pair(camera, seed, seed * 100_000_000)) for seed in range(PAIRS)]
    amount = sum(frame_bytes(frame) for pair in pairs for frame in (pair.camera, pair.lidar))
    spent_s = []
    for number in range(WINDOWS):
        with tempfile.TemporaryDirectory() as folder:
            name = f"bench-{number}"
            packed = StateConfig().packing == "lz4"
            path, start = Path(folder) / f"{name}.mcap", rig.T_camera_lidar_nominal
            begin_s = time.process_time()
            writer = WindowWriter(path, rig, start, name, CalibrationConfig(), {}, packed=packed)
            for pair in pairs:
                writer.add(pair)
            writer.finish()
            spent_s.append(time.process_time() - begin_s)
    return {"recording_cpu_percent": 100.0 * min(spent_s) * RATE_BYTES_PER_S / amount}


def _in_millimetres(pair: FramePair) -> FramePair:
    """The pair with points as drivers give them, in whole millimetres, and intensities in hundredths. In data with
    noise in every bit, lz4 would find nothing to compress and take no time."""
    rng = np.random.default_rng(pair.stamp_ns)
    brightness = np.round(rng.random(len(pair.lidar.xyz_m)), 2).astype(np.float32)
    xyz_m = np.round(pair.lidar.xyz_m, 3).astype(np.float32)
    return replace(pair, lidar=replace(pair.lidar, xyz_m=xyz_m, intensity=brightness))
