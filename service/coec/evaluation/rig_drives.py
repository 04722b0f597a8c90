"""Rendered drives of a rig on which sensors are knocked. Each drive is drawn twice, with the rig as it was built and
with the knocked sensors displaced. Every pair is looked at, and windows of pairs that suspect a move are solved.
`rig_drive_statistics` later asks which sensor moved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from coec.calibration.monitor.sensors import PreparedSweep, prepare_sweep
from coec.calibration.types import FramePair, LidarFrame
from coec.errors import CoecError
from coec.evaluation.check_drives import CHECK_PAIRS
from coec.evaluation.knocked_drive import FIRST_SEED, LIDAR, DisplacedRigDrive
from coec.evaluation.rig_drive_windows import urgent_windows
from coec.evaluation.rig_looks import TURN_S, SeenPair, due, observe
from coec.schemas.replies import Vector6
from coec.schemas.rig import Mounts, RigDriveRow, RigLook
from coec.simulation.journey import START_NS
from coec.simulation.rig_instants import Instant, instants, pair_of

Seen = Mapping[tuple[str, Mounts], SeenPair]
"""The pairs of an instant by camera, and by which of their sensors has moved."""


def driven(drive: DisplacedRigDrive) -> RigDriveRow:
    """All looks and urgent windows of a drive; an error becomes the row's `failure`.

    Raises:
        UsageError: there is no such camera.
    """
    stops = instants(drive.right, LIDAR, TURN_S)
    row = RigDriveRow(name=drive.name, seed=FIRST_SEED + drive.number, camera=drive.camera)
    try:
        seen = [_seen(drive, instant) for instant in stops]
        checks = tuple(_checks(drive, seen))
        frames = {key: [of.frames for of in _of(seen, *key)] for key in _variants(drive)}
        windows = tuple(urgent_windows(drive, frames, checks))
    except CoecError as error:
        return row.model_copy(update={"failure": f"{type(error).__name__}: {error}"})
    return row.model_copy(update={"looks": checks, "windows": windows})


def _variants(drive: DisplacedRigDrive) -> Iterator[tuple[str, Mounts]]:
    """Each camera as built, with the LiDAR moved, and moved itself if it is one of those that may be knocked."""
    for camera in drive.right.cameras:
        yield from ((camera, mounts) for mounts in Mounts if mounts is not Mounts.CAMERA or camera in drive.cameras)


def _of(seen: Sequence[Seen], camera: str, mounts: Mounts) -> list[SeenPair]:
    """The pairs of a camera, from the knock on with its sensors as `mounts` says."""
    pairs = (one.get((camera, mounts)) or one.get((camera, Mounts.AS_BUILT)) for one in seen)
    return [pair for pair in pairs if pair is not None]


def _checks(drive: DisplacedRigDrive, seen: Sequence[Seen]) -> Iterator[RigLook]:
    """In the order of their stamps."""
    for number in range(1, len(seen) + 1):
        for camera in due(number, drive.right.cameras):
            yield from _checks_of(drive, camera, seen[max(number - CHECK_PAIRS, 0) : number])


def _checks_of(drive: DisplacedRigDrive, camera: str, latest: Sequence[Seen]) -> Iterator[RigLook]:
    """Looks at one pair: with all sensors as built, and with each sensor moved that has moved in its latest frames."""
    rig = drive.right.pair(camera, LIDAR).rig
    for mounts in Mounts:
        if (camera, mounts) not in latest[-1] and mounts is not Mounts.AS_BUILT:
            continue
        observation = observe(rig, drive.served[rig.pair], _of(latest, camera, mounts))
        yield RigLook(
            edge=rig.pair, mounts=mounts, pair_stamps_ns=observation.pair_stamps_ns, offset=_six(observation.offset),
            sigma=_six(observation.sigma), noise=_six(observation.noise), place=_six(observation.place), dispersion=observation.dispersion,
            distance2=observation.distance2, flagged=observation.flagged, weak=observation.weak,
            causes=tuple(cause.code for cause in observation.causes),
        )  # fmt: skip


def _seen(drive: DisplacedRigDrive, instant: Instant) -> dict[tuple[str, Mounts], SeenPair]:
    """The pairs of an instant: one of every camera with all sensors as built, and after the knock also one for each
    knocked sensor in it."""
    right, displaced = drive.right, drive.displaced
    motions = tuple(right.message(entry) for entry in instant.motions)
    seen_pairs: dict[tuple[str, Mounts], SeenPair] = {}
    sweep = right.message(instant.sweep)
    assert isinstance(sweep, LidarFrame)
    of_sweep = prepare_sweep(sweep)
    moved = displaced.message(instant.sweep) if _is_after(drive, instant.sweep.stamp_ns) else None
    of_moved = prepare_sweep(moved) if isinstance(moved, LidarFrame) else None
    for camera, entry in instant.pictures.items():
        picture = right.message(entry)
        seen_pairs |= _joined((camera, Mounts.AS_BUILT), pair_of(picture, sweep, motions), of_sweep)
        if moved is not None and of_moved is not None:
            seen_pairs |= _joined((camera, Mounts.LIDAR), pair_of(picture, moved, motions), of_moved)
        if camera in drive.cameras and _is_after(drive, entry.stamp_ns):
            seen_pairs |= _joined((camera, Mounts.CAMERA), pair_of(displaced.message(entry), sweep, motions), of_sweep)
    return seen_pairs


def _joined(
    key: tuple[str, Mounts], frames: FramePair | None, sweep: PreparedSweep
) -> dict[tuple[str, Mounts], SeenPair]:
    return {} if frames is None else {key: SeenPair(frames, sweep)}


def _is_after(drive: DisplacedRigDrive, stamp_ns: int) -> bool:
    return stamp_ns - START_NS >= drive.at_s * 1e9


def _six(values: NDArray[np.float64]) -> Vector6:
    rx, ry, rz, tx, ty, tz = (float(value) for value in values)
    return rx, ry, rz, tx, ty, tz
