"""Simulated drives for the tests of the running service: each is drawn once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coec.calibration.types import CameraFrame, Frame
from coec.config import CalibrationConfig, DepthConfig, MonitorConfig, PolicyConfig, WindowConfig
from coec.geometry.se3 import inverse, rotation_angle_rad
from coec.io.recordings.recording_source import parse_spec
from coec_lab.simulation.source import open_sim
from e2e.processes import Router, write_configuration
from support.simulated_drives import rendered_source

if TYPE_CHECKING:
    from coec_lab.simulation.drive import SimulatedDrive

NS_PER_S = 1_000_000_000

SHORT = "seed=1&seconds=12&camera=pinhole240x120&lidar=32&camera_hz=0.5&lidar_hz=0.5&ego_hz=10&depth=yes"
"""Six pairs in twelve seconds, from which `mi` finds the mount to a tenth of a degree."""

SHORT_PAIRS = 6

SECONDS, STEP_S, RATE_HZ = 100, 40, 1.0
EARLY_SECONDS, EARLY_STEP_S = 72, 24


def _stepped(seconds: int, step_s: int) -> str:
    return (
        f"seed=1&seconds={seconds}&camera=pinhole480x240&lidar=32&camera_hz={RATE_HZ}&lidar_hz={RATE_HZ}&ego_hz=10"
        f"&depth=yes&faults=step:{step_s}:ry=1"
    )


STEPPED = _stepped(SECONDS, STEP_S)
"""The mount moves by one degree in yaw, when one window and several checks have passed."""

EARLY_STEPPED = _stepped(EARLY_SECONDS, EARLY_STEP_S)
"""The same sooner, for shorter windows."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive with its frames in the order in which they are sent."""

    source: str
    recording: SimulatedDrive
    frames: tuple[Frame, ...]

    @property
    def start_ns(self) -> int:
        """Stamp of the first picture."""
        return self.recording.camera_stamps_ns[0]

    def between(self, begin_s: float, end_s: float) -> list[Frame]:
        """The frames of a part of a drive at `RATE_HZ`; no pair is torn."""
        half_s = 0.5 / RATE_HZ
        return [f for f in self.frames if begin_s <= (f.stamp_ns - self.start_ns) / NS_PER_S + half_s < end_s]

    def error_deg(self, extrinsic: Any, second: float) -> float:
        """Of the rotation of what is served (a reply) against the truth at this second of the drive."""
        right = self.recording.truth(self.start_ns + round(second * NS_PER_S))
        served = np.array(extrinsic["camera_from_lidar"]["matrix"])
        return float(np.degrees(rotation_angle_rad(served @ inverse(right))))


@cache
def rendered(query: str) -> Drive:
    """The drive of `sim:QUERY`."""
    source = f"sim:{query}"
    return Drive(source, open_sim(parse_spec(source).query), tuple(rendered_source(source).messages()))


def later(frames: Sequence[Frame], seconds: float) -> list[Frame]:
    """The frames as if they had been taken later."""
    return [replace(frame, stamp_ns=frame.stamp_ns + round(seconds * NS_PER_S)) for frame in frames]


def without_depth(frames: Sequence[Frame]) -> list[Frame]:
    """The frames as a real camera sends them."""
    return [replace(frame, depth=None) if isinstance(frame, CameraFrame) else frame for frame in frames]


def stepped_configuration(
    folder: Path, router: Router, depth: DepthConfig, slice_s: float = 32.0, **policy: Any
) -> Path:
    """A configuration for the drive with the step, with short windows."""
    return write_configuration(
        folder,
        open_sim(parse_spec(f"sim:{STEPPED}").query),
        router.endpoint,
        window=WindowConfig(pairs=16, min_pairs=8, slice_s=slice_s),
        monitor=MonitorConfig(period_s=5.0, pairs=5, min_pairs=4, urgent_slice_s=16.0),
        calibration=CalibrationConfig(depth=depth),
        policy=PolicyConfig(**policy),
    )
