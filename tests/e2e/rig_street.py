"""Streets for simulated rigs, with nobody, a LiDAR or a camera knocked: an instant a second, of which each frame is
drawn once, whatever number of drives has it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context

from coec.calibration.types import Frame, Matrix4
from coec_lab.experiments.rig_drives import ROWS
from coec_lab.simulation.drive import Arrival
from coec_lab.simulation.faults import SensorFault, StepFault
from coec_lab.simulation.journey import START_NS
from coec_lab.simulation.rig_drive import FOUR_FISHEYES, RigDrive, RigDriveConfig, RigLayout, instants
from support.simulated_drives import cached_messages

NS_PER_S = 1_000_000_000

LIDAR = "roof"
PERIOD_S = 1.0
"""Between two instants."""

PART = 12
"""Frames that a process draws at once, one after the other: of about three instants."""


@dataclass(frozen=True)
class Knock:
    """A sensor, and by how many degrees it turns about the second of its axes."""

    sensor: str
    turn_deg: float


@dataclass(frozen=True, eq=False)
class Street:
    """A drive of a rig along a street; what is knocked is knocked at `knock_s`.

    Attributes:
        layout: of which `lidars` send; instants are those of the first of these.
        camera: of every camera, `fisheyeW`.
        rows: of pictures that are drawn, shares of their height.
    """

    layout: RigLayout
    lidars: tuple[str, ...]
    seed: int
    camera: str
    seconds: int
    knock_s: int
    rows: tuple[float, float]

    @property
    def name(self) -> tuple[object, ...]:
        """By which its frames are kept."""
        sensors = (*self.layout.names, *self.lidars)
        return ("rig street", self.seed, self.camera, self.seconds, self.knock_s, self.rows, sensors)

    def config_of(self, knock: Knock | None) -> RigDriveConfig:
        """Of a drive; None: nobody is knocked."""
        faults: tuple[SensorFault, ...] = ()
        if knock is not None:
            faults = (SensorFault(knock.sensor, StepFault(self.knock_s, float("inf"), ry=knock.turn_deg)),)
        return RigDriveConfig(
            layout=self.layout, seed=self.seed, seconds=self.seconds, camera=self.camera, ego_hz=20.0, faults=faults,
            rows=self.rows, depth=True,
        )  # fmt: skip

    def drive_of(self, knock: Knock | None) -> RigDrive:
        """With the truth."""
        return _drive_of(self, knock)

    def frames_of(self, knock: Knock | None) -> list[Frame]:
        """In the order of their stamps."""
        result = dict(_as_built(self))
        if knock is not None:
            moved = self.drive_of(None).stream(knock.sensor)
            after = [e for e in result if e.stream == moved and second_of(e.stamp_ns) >= self.knock_s]
            config = self.config_of(knock)
            result |= zip(
                after, cached_messages((*self.name, knock, after), lambda: rendered(config, after)), strict=True
            )
        return sorted(result.values(), key=lambda frame: frame.stamp_ns)

    def truth(self, knock: Knock | None, camera: str, lidar: str, second: float) -> Matrix4:
        """True T_camera_lidar (4, 4)."""
        return self.drive_of(knock).pair(camera, lidar).truth(START_NS + round(second * NS_PER_S))


FOUR_AND_ONE = Street(FOUR_FISHEYES, (LIDAR,), seed=7, camera="fisheye700", seconds=96, knock_s=24, rows=ROWS)
"""Four fisheyes and a LiDAR. Rows of pictures that the LiDAR does not see are not drawn."""

TWO_AND_THREE = Street(
    replace(FOUR_FISHEYES, cameras=FOUR_FISHEYES.cameras[:2]),
    ("roof", "near_left", "near_right"),
    seed=9, camera="fisheye500", seconds=100, knock_s=30, rows=ROWS,
)  # fmt: skip
"""Two fisheyes and three LiDARs, of which those on the flanks see some of what the one on the roof does."""


def second_of(stamp_ns: int) -> float:
    """Of a drive."""
    return (stamp_ns - START_NS) / NS_PER_S


@cache
def _drive_of(street: Street, knock: Knock | None) -> RigDrive:
    return street.config_of(knock).drive()


@cache
def _as_built(street: Street) -> dict[Arrival, Frame]:
    drive, config = street.drive_of(None), street.config_of(None)
    entries: dict[Arrival, None] = {}
    for instant in instants(drive, street.lidars[0], PERIOD_S):
        sweeps = (instant.sweep, *(_nearest(drive, lidar, instant.sweep.stamp_ns) for lidar in street.lidars[1:]))
        entries |= dict.fromkeys((*sweeps, *instant.pictures.values(), *instant.motions))
    plan = list(entries)
    return dict(zip(plan, cached_messages((*street.name, plan), lambda: rendered(config, plan)), strict=True))


def _nearest(drive: RigDrive, lidar: str, stamp_ns: int) -> Arrival:
    """The sweep of a LiDAR that is nearest to a time."""
    stream = drive.stream(lidar)
    return min((e for e in drive.plan if e.stream == stream), key=lambda entry: abs(entry.stamp_ns - stamp_ns))


def rendered(config: RigDriveConfig, entries: Sequence[Arrival]) -> list[Frame]:
    """By two processes, in the order of the entries."""
    parts = [entries[begin : begin + PART] for begin in range(0, len(entries), PART)]
    with ProcessPoolExecutor(2, get_context("spawn"), _open, (config,)) as pool:
        return [frame for part in pool.map(_render, parts) for frame in part]


_drive: RigDrive | None = None


def _open(config: RigDriveConfig) -> None:
    global _drive  # one drive per process, as the pool's initializer gives it
    _drive = config.drive()


def _render(entries: Sequence[Arrival]) -> list[Frame]:
    assert _drive is not None
    return [_drive.message(entry) for entry in entries]
