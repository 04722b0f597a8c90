"""What the demonstration plays: the drive, the knock, the service's configuration, and when the story has come true."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from coec.adapters.files.rig import intrinsics_config, matrix_rows
from coec.adapters.zenoh.player import Streams
from coec.calibration.types import Rig
from coec.config import (
    BudgetConfig,
    CameraConfig,
    Config,
    EgoConfig,
    LidarConfig,
    MonitorConfig,
    PairConfig,
    StateConfig,
    WindowConfig,
    WorkerConfig,
    ZenohConfig,
)
from coec.simulation.source import require_extra

if TYPE_CHECKING:
    from coec.simulation.drive import DriveConfig

SEED = 1
LONGEST_S = 240.0
"""Longest drive; it ends as soon as the story is told."""

WORKSHOP = (0.6, -0.5, 0.4, 0.0, 0.0, 0.0)
"""Error of the workshop's calibration: degrees in pitch, yaw, roll, and metres."""

KNOCK_S, KNOCK_DEG = 36.0, 3.0
"""When and by how much the mount is knocked, in pitch: after the first window has been judged."""

TITLE = f"A mount that is knocked by {KNOCK_DEG:g}° while the vehicle drives"
REPORT = "report.html"
"""File of the page, which exists from the first picture on."""

REST_S = 12.0
"""Driving after the repair: two more checks of the monitor."""

CLOSE_UP_PX = (170, 285, 400, 170)
"""Left, top, width and height of the part of the picture that shows cars and kerbs."""

PAIR_HZ, EGO_HZ = 1.0, 50.0
"""Frames per second of driving: only as many pairs are rendered as the service would choose."""

WINDOW = WindowConfig(pairs=12, min_pairs=8, slice_s=24.0)
MONITOR = MonitorConfig(period_s=5.0, pairs=5, min_pairs=4, urgent_slice_s=12.0)
"""Shorter than on a vehicle, where a window takes three minutes, which is too long to watch."""

STORY_CORES = 64.0
"""Budget of the service: in the story, windows come every few seconds, for which the default is too small."""

MAX_ERROR_DEG = 0.25
"""How near the repair must be to the truth (geodesic angle)."""

MIN_FREE_BYTES = 64 * 2**20
"""Small, because a demonstration writes only some windows of 20 MB."""


def drive_config() -> DriveConfig:
    """A vehicle with a 185° fisheye of 700×700 pixels and a LiDAR of 64 beams, and the knock.

    Raises:
        SourceError: the library that casts rays is not installed.
    """
    require_extra()
    from coec.simulation.drive import DriveConfig
    from coec.simulation.faults import Step

    return DriveConfig(
        seed=SEED,
        seconds=LONGEST_S,
        camera="fisheye700",
        lidar="64",
        camera_hz=PAIR_HZ,
        lidar_hz=PAIR_HZ,
        ego_hz=EGO_HZ,
        faults=(Step(KNOCK_S, LONGEST_S, rx=KNOCK_DEG),),
        workshop=WORKSHOP,
    )


def service_config(rig: Rig, mask: Path, endpoint: str) -> Config:
    """Configuration of the service: defaults, except for rig, address, and what is shorter than on a vehicle."""
    streams = Streams.default(rig.pair)
    pair = PairConfig(
        name=rig.pair,
        camera=CameraConfig(
            key=streams.camera,
            frame_id=rig.camera_frame,
            intrinsics=intrinsics_config(rig.camera),
            mask=mask,
        ),
        lidar=LidarConfig(key=streams.lidar, frame_id=rig.lidar_frame),
        ego=EgoConfig(key=str(streams.ego), T_lidar_ego=matrix_rows(rig.T_lidar_ego)),
        T_camera_lidar=matrix_rows(rig.T_camera_lidar_nominal),
        window=WINDOW,
        monitor=MONITOR,
    )
    return Config(
        budget=BudgetConfig(cores=STORY_CORES),
        zenoh=ZenohConfig(connect=(endpoint,), listen=(endpoint,)),
        state=StateConfig(directory=Path("state"), min_free_bytes=MIN_FREE_BYTES),
        # The solver competes with rendering here; on a vehicle cameras take no processor time.
        worker=WorkerConfig(niceness=0),
        pairs=(pair,),
    )
