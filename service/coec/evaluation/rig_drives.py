"""Rendered drives of a rig on which sensors are knocked. Each drive is drawn twice, with the rig as it was built and
with the knocked sensors displaced, and every pair is looked at. `rig_drive_statistics` later asks which sensor moved.

All faults of one drive number share a street, so the frames of a sensor that did not move are the same in all of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import degrees, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.sensors import PreparedSweep, prepare_sweep
from coec.calibration.rig.types import RigGraph
from coec.calibration.types import FramePair, LidarFrame, Matrix4
from coec.errors import CoecError
from coec.evaluation.check_drives import CHECK_PAIRS
from coec.evaluation.rig_evidence import WINDOW
from coec.evaluation.rig_looks import ROWS, TURN_S, SeenPair, due, graph_of, look_at
from coec.geometry import se3
from coec.geometry.vectors import random_direction
from coec.schemas.replies import Vector6
from coec.schemas.rig import Mounts, RigDriveRow, RigLook
from coec.simulation.faults import SensorFault, Step
from coec.simulation.journey import START_NS
from coec.simulation.rig_drive import RigConfig, RigDrive
from coec.simulation.rig_instants import Instant, instants, pair_of

LIDAR = "roof"
"""Name of the rig's LiDAR; the rig has four fisheyes and one LiDAR of 64 beams."""

AT_S = (16.0, 22.0)
"""Sensors are knocked at a random time within these, seconds of the drive: after two or three looks at every pair."""

AFTER_S = 60.5
"""Driving after the knock: as long as an alarm may take, and long enough that the last pair is begun."""

STEP_RAD = radians(1.0)

FIRST_SEED = 1_760_001
"""Beyond all seeds from which anything was learned."""


@dataclass(frozen=True)
class KnockedDrive:
    """A drive by its number.

    Attributes:
        camera: model of every camera, `fisheyeW`.
    """

    number: int
    camera: str

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.camera}_{FIRST_SEED + self.number}"

    @cached_property
    def _drawn(self) -> tuple[float, tuple[str, str], dict[str, NDArray[np.float64]]]:
        rng = np.random.default_rng([FIRST_SEED, self.number])
        one, other = (str(name) for name in rng.permutation(RigConfig().drive().cameras)[:2])
        at_s = float(rng.uniform(*AT_S))
        turns = {name: STEP_RAD * random_direction(rng) for name in (one, other, LIDAR)}
        return at_s, (one, other), turns

    @property
    def at_s(self) -> float:
        """When sensors are knocked."""
        return self._drawn[0]

    @property
    def cameras(self) -> tuple[str, str]:
        """The cameras that may be knocked: a fault takes the first alone, or both."""
        return self._drawn[1]

    @cached_property
    def right(self) -> RigDrive:
        """As the rig was built."""
        return self._config(()).drive()

    @cached_property
    def knocked(self) -> RigDrive:
        """Both cameras and the LiDAR turned, each about an axis of its own."""
        faults = []
        for name, turn in self._drawn[2].items():
            rx, ry, rz = (degrees(angle) for angle in turn)
            faults.append(SensorFault(name, Step(self.at_s, float("inf"), rx=rx, ry=ry, rz=rz)))
        return self._config(tuple(faults)).drive()

    @cached_property
    def graph(self) -> RigGraph:
        """As the rig was built."""
        return graph_of(self.right, LIDAR)

    @cached_property
    def served(self) -> dict[str, Matrix4]:
        """Served extrinsic (4, 4) of each pair: off the truth by as much as windows are (`WINDOW`)."""
        rng = np.random.default_rng([FIRST_SEED, self.number, 1])
        return {edge.name: se3.perturb(edge.T_a_b, WINDOW * rng.normal(size=6)) for edge in self.graph.edges}

    def _config(self, faults: tuple[SensorFault, ...]) -> RigConfig:
        seconds = self.at_s + AFTER_S
        return RigConfig(
            seed=FIRST_SEED + self.number, seconds=seconds, camera=self.camera, ego_hz=20.0, faults=faults, rows=ROWS
        )  # fmt: skip


def looked_at(drive: KnockedDrive) -> RigDriveRow:
    """All looks of a drive; an error becomes the row's `failure`.

    Raises:
        UsageError: there is no such camera.
    """
    stops = instants(drive.right, LIDAR, TURN_S)
    row = RigDriveRow(name=drive.name, seed=FIRST_SEED + drive.number, camera=drive.camera, looks=())
    try:
        looks = tuple(_looks(drive, stops))
    except CoecError as error:
        return row.model_copy(update={"failure": f"{type(error).__name__}: {error}"})
    return row.model_copy(update={"looks": looks})


def _looks(drive: KnockedDrive, stops: Sequence[Instant]) -> Iterator[RigLook]:
    """In the order of their stamps."""
    kept: deque[dict[tuple[str, Mounts], SeenPair]] = deque(maxlen=CHECK_PAIRS)
    for number, instant in enumerate(stops):
        kept.append(_seen(drive, instant))
        for camera in due(number + 1, drive.right.cameras):
            yield from _looks_of(drive, camera, list(kept))


def _looks_of(drive: KnockedDrive, camera: str, kept: list[dict[tuple[str, Mounts], SeenPair]]) -> Iterator[RigLook]:
    """Looks at one pair: with all sensors as built, and with each sensor moved that has moved in its latest frames."""
    rig = drive.right.pair(camera, LIDAR).rig
    for mounts in Mounts:
        if (camera, mounts) not in kept[-1] and mounts is not Mounts.AS_BUILT:
            continue
        seen = [one.get((camera, mounts)) or one.get((camera, Mounts.AS_BUILT)) for one in kept]
        pairs = [pair for pair in seen if pair is not None]
        told = look_at(rig, drive.served[rig.pair], pairs)
        yield RigLook(
            edge=rig.pair, mounts=mounts, pair_stamps_ns=told.pair_stamps_ns, offset=_six(told.offset),
            sigma=_six(told.sigma), noise=_six(told.noise), place=_six(told.place), dispersion=told.dispersion,
            distance2=told.distance2, flagged=told.flagged, weak=told.weak,
            causes=tuple(cause.code for cause in told.causes),
        )  # fmt: skip


def _seen(drive: KnockedDrive, instant: Instant) -> dict[tuple[str, Mounts], SeenPair]:
    """The pairs of an instant: one of every camera with all sensors as built, and after the knock also one for each
    knocked sensor in it."""
    right, knocked = drive.right, drive.knocked
    motions = tuple(right.message(entry) for entry in instant.motions)
    found: dict[tuple[str, Mounts], SeenPair] = {}
    sweep = right.message(instant.sweep)
    assert isinstance(sweep, LidarFrame)
    of_sweep = prepare_sweep(sweep)
    moved = knocked.message(instant.sweep) if _is_after(drive, instant.sweep.stamp_ns) else None
    of_moved = prepare_sweep(moved) if isinstance(moved, LidarFrame) else None
    for camera, entry in instant.pictures.items():
        picture = right.message(entry)
        found |= _joined((camera, Mounts.AS_BUILT), pair_of(picture, sweep, motions), of_sweep)
        if moved is not None and of_moved is not None:
            found |= _joined((camera, Mounts.LIDAR), pair_of(picture, moved, motions), of_moved)
        if camera in drive.cameras and _is_after(drive, entry.stamp_ns):
            found |= _joined((camera, Mounts.CAMERA), pair_of(knocked.message(entry), sweep, motions), of_sweep)
    return found


def _joined(
    key: tuple[str, Mounts], frames: FramePair | None, sweep: PreparedSweep
) -> dict[tuple[str, Mounts], SeenPair]:
    return {} if frames is None else {key: SeenPair(frames, sweep)}


def _is_after(drive: KnockedDrive, stamp_ns: int) -> bool:
    return stamp_ns - START_NS >= drive.at_s * 1e9


def _six(values: NDArray[np.float64]) -> Vector6:
    rx, ry, rz, tx, ty, tz = (float(value) for value in values)
    return rx, ry, rz, tx, ty, tz
