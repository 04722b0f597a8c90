"""One street for a simulated rig of four fisheyes and a LiDAR, with nobody, the LiDAR or a camera knocked: an instant a
second, of which each frame is drawn once, whatever number of drives has it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context

from coec.adapters.zenoh.player import Frame
from coec.calibration.types import Matrix4
from coec.evaluation.rig_looks import ROWS
from coec.simulation.faults import SensorFault, Step
from coec.simulation.journey import START_NS
from coec.simulation.rig_drive import RigConfig, RigDrive
from coec.simulation.rig_instants import instants
from coec.simulation.schedule import Arrival
from drives import kept

NS_PER_S = 1_000_000_000

LIDAR = "roof"
SECONDS, KNOCK_S = 96, 24
SEED, CAMERA = 7, "fisheye700"
PERIOD_S = 1.0
"""Between two instants."""

STREET = ("rig street", SEED, CAMERA, SECONDS, KNOCK_S, ROWS)
"""By which its frames are kept."""

PART = 12
"""Frames that a process draws at once, one after the other: of about three instants."""


@dataclass(frozen=True)
class Knock:
    """A sensor, and by how many degrees it turns about the second of its axes."""

    sensor: str
    turn_deg: float


def config_of(knock: Knock | None) -> RigConfig:
    """Of a drive; None: nobody is knocked. Rows of pictures that the LiDAR does not see are not drawn."""
    faults: tuple[SensorFault, ...] = ()
    if knock is not None:
        faults = (SensorFault(knock.sensor, Step(KNOCK_S, float("inf"), ry=knock.turn_deg)),)
    return RigConfig(
        seed=SEED, seconds=SECONDS, camera=CAMERA, ego_hz=20.0, faults=faults, rows=ROWS, depth=True
    )  # fmt: skip


@cache
def drive_of(knock: Knock | None) -> RigDrive:
    """With the truth."""
    return config_of(knock).drive()


def frames_of(knock: Knock | None) -> list[Frame]:
    """In the order of their stamps."""
    found = dict(_as_built())
    if knock is not None:
        moved = drive_of(None).stream(knock.sensor)
        after = [entry for entry in found if entry.stream == moved and second_of(entry.stamp_ns) >= KNOCK_S]
        config = config_of(knock)
        found |= zip(after, kept((*STREET, knock, after), lambda: drawn(config, after)), strict=True)
    return sorted(found.values(), key=lambda frame: frame.stamp_ns)


def truth(knock: Knock | None, camera: str, second: float) -> Matrix4:
    """True T_camera_lidar (4, 4)."""
    return drive_of(knock).pair(camera, LIDAR).truth(START_NS + round(second * NS_PER_S))


def second_of(stamp_ns: int) -> float:
    """Of the drive."""
    return (stamp_ns - START_NS) / NS_PER_S


@cache
def _as_built() -> dict[Arrival, Frame]:
    drive, config = drive_of(None), config_of(None)
    entries: dict[Arrival, None] = {}
    for instant in instants(drive, LIDAR, PERIOD_S):
        entries |= dict.fromkeys((instant.sweep, *instant.pictures.values(), *instant.motions))
    plan = list(entries)
    return dict(zip(plan, kept((*STREET, plan), lambda: drawn(config, plan)), strict=True))


def drawn(config: RigConfig, entries: Sequence[Arrival]) -> list[Frame]:
    """By two processes, in the order of the entries."""
    parts = [entries[begin : begin + PART] for begin in range(0, len(entries), PART)]
    with ProcessPoolExecutor(2, get_context("spawn"), _open, (config,)) as pool:
        return [frame for part in pool.map(_draw, parts) for frame in part]


_drive: RigDrive | None = None


def _open(config: RigConfig) -> None:
    global _drive  # one drive per process, as the pool's initializer gives it
    _drive = config.drive()


def _draw(entries: Sequence[Arrival]) -> list[Frame]:
    assert _drive is not None
    return [_drive.message(entry) for entry in entries]
