"""What a calibration says about windows during which the mount moved: knocks of known size at known times are applied
to a recording whose pose is known.

Moving the later sweeps by S⁻¹ is the same as moving the mount by S, but for the few centimetres by which a turn about
the camera moves the LiDAR. Sweeps are motion-compensated first, with the mount as it was.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration import types
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.pipeline import calibrate
from coec.config import CalibrationConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.points import random_direction
from coec_lab.experiments.evaluation_schema import StepRow

WRONG_RAD, WRONG_SIGMAS = radians(0.3), 4.0
"""An accepted window is wrong if its rotation is farther than both of these from the mount at the window's end."""

KNOWN_TO_S = 2.0
"""The time of a step counts as known if it is reported to within this, s."""

NS_PER_S = 1_000_000_000

SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""


@dataclass(frozen=True, slots=True)
class MountStep:
    """A movement of the mount within a window: a turn about a random axis (rad) and a shift in a random direction (m),
    either at once between two pairs or, if it creeps, evenly in time from the first pair to the last."""

    name: str
    turn_rad: float
    shift_m: float = 0.0
    creeps: bool = False

    @property
    def moves(self) -> bool:
        """Whether the mount moves at all."""
        return self.turn_rad > 0.0 or self.shift_m > 0.0


MOUNT_STEPS = (
    MountStep("none", 0.0),
    MountStep("0.3 deg", radians(0.3)),
    MountStep("0.5 deg", radians(0.5)),
    MountStep("1 deg", radians(1.0)),
    MountStep("2 deg", radians(2.0)),
    MountStep("3 deg", radians(3.0)),
    MountStep("6 deg", radians(6.0)),
    MountStep("5 cm", 0.0, 0.05),
    MountStep("10 cm", 0.0, 0.10),
    MountStep("1 deg, slowly", radians(1.0), creeps=True),
)


@dataclass(frozen=True, slots=True)
class MountStepTrial:
    """What the calibration said about one window.

    Attributes:
        name: of the knock.
        accepted: whether the window was accepted.
        wrong: whether it was accepted with a pose other than that of the mount at its end.
        moved: whether it was refused because the camera moved within it.
        off_s: how far the middle of the reported interval is from the time of the knock, s; None where no time was
            reported, or there was no step.
        interval_s: length of the reported interval, s; None likewise.
        holds: whether the interval holds the knock; None likewise.
        late: share of the pairs after the knock.
    """

    name: str
    accepted: bool
    wrong: bool
    moved: bool
    off_s: float | None
    interval_s: float | None
    holds: bool | None
    late: float


def try_mount_steps(
    window: types.Window,
    depth: types.DepthModel,
    images: types.ImageReader,
    config: CalibrationConfig,
    trials: int,
    knocks: Sequence[MountStep],
    on_progress: Callable[[int], None],
) -> list[MountStepTrial]:
    """Solves `window`, whose start must be the true pose, `trials` times with every knock (seeded) and once without
    one; `heard(done)` counts the solves.

    Raises:
        CalibrationError: fewer than two pairs, or there is no estimate even without a knock.
    """
    if len(window.pairs) < 2:
        raise CalibrationError(f"a step lies between two pairs of a window, there are {len(window.pairs)}")
    pairs, between = (_compensated(of, window, config) for of in (window.pairs, window.between))
    still = replace(window, pairs=pairs, between=between, start_known_to_rad=types.MOUNT_RAD)
    config = config.model_copy(update={"motion_compensation": False})
    # Each recording has knocks of its own, so that many recordings show many knocks.
    recording_hash = zlib.crc32(window.pairs[0].camera.image.data)
    tried: list[MountStepTrial] = []
    for number, knock in enumerate(knocks):
        # Without a knock every trial is the same.
        for trial in range(trials if knock.moves else 1):
            rng = np.random.default_rng([SEED, number, trial, recording_hash])
            tried.append(_try(knock, still, depth, images, config, rng))
            on_progress(len(tried))
    return tried


def table(tried: Sequence[MountStepTrial]) -> tuple[StepRow, ...]:
    """The shares by knock, in the order of their first trials."""
    rows = []
    for name in dict.fromkeys(one.name for one in tried):
        of = [one for one in tried if one.name == name]
        known = [one.off_s is not None and one.off_s <= KNOWN_TO_S for one in of]
        has_time = not any(knock.name == name and (knock.creeps or not knock.moves) for knock in MOUNT_STEPS)
        timed = [one for one in of if one.off_s is not None]
        rows.append(
            StepRow(
                name=name,
                windows=len(of),
                accepted=sum(one.accepted for one in of) / len(of),
                wrong=sum(one.wrong for one in of) / len(of),
                moved=sum(one.moved for one in of) / len(of),
                time_known=sum(known) / len(of) if has_time else None,
                off_s=_median([one.off_s for one in timed]),
                told_s=_median([one.interval_s for one in timed]),
                holds=sum(bool(one.holds) for one in timed) / len(timed) if timed else None,
            )
        )
    return tuple(rows)


def _try(
    knock: MountStep,
    still: types.Window,
    depth: types.DepthModel,
    images: types.ImageReader,
    config: CalibrationConfig,
    rng: np.random.Generator,
) -> MountStepTrial:
    count, start = len(still.pairs), still.T_camera_lidar_start
    first_late = int(rng.integers(1, count))
    xi = np.concatenate([knock.turn_rad * random_direction(rng), knock.shift_m * random_direction(rng)])
    at_ns = int(rng.integers(still.pairs[first_late - 1].stamp_ns, still.pairs[first_late].stamp_ns))
    begin_ns, length_ns = still.pairs[0].stamp_ns, still.stamp_ns - still.pairs[0].stamp_ns

    def displaced(pairs: Sequence[types.FramePair]) -> tuple[types.FramePair, ...]:
        if knock.creeps:
            return tuple(_moved(pair, start, xi * ((pair.stamp_ns - begin_ns) / length_ns)) for pair in pairs)
        return tuple(_moved(pair, start, xi * (pair.stamp_ns > at_ns)) for pair in pairs)

    moved = replace(still, pairs=displaced(still.pairs), between=displaced(still.between))
    late = 1 - first_late / count
    try:
        estimate = calibrate(moved, depth, images, config, types.Silence())
    except CalibrationError:
        return MountStepTrial(
            knock.name, accepted=False, wrong=False, moved=False, off_s=None, interval_s=None, holds=None, late=late
        )
    accepted = estimate.verdict.decision is types.Decision.ACCEPTED
    off_s = interval_s = holds = None
    if (motion := estimate.moved) is not None and knock.moves and not knock.creeps:
        off_s = abs((motion.last_before_ns + motion.first_after_ns) // 2 - at_ns) / NS_PER_S
        interval_s = (motion.first_after_ns - motion.last_before_ns) / NS_PER_S
        holds = motion.last_before_ns <= at_ns < motion.first_after_ns
    return MountStepTrial(
        knock.name,
        accepted,
        accepted and _is_wrong(estimate, se3.perturb(start, xi)),
        any(reason.code == types.MOVED for reason in estimate.verdict.reasons),
        off_s,
        interval_s,
        holds,
        late,
    )


def _median(values: Sequence[float | None]) -> float | None:
    """Median of what was reported; None if nothing was."""
    return float(np.median([one for one in values if one is not None])) if values else None


def _compensated(
    pairs: Sequence[types.FramePair], window: types.Window, config: CalibrationConfig
) -> tuple[types.FramePair, ...]:
    """The pairs with their sweeps compensated to the instants of the exposures."""

    def of(pair: types.FramePair) -> types.FramePair:
        xyz_m = compensate(pair, window.rig, enabled=config.motion_compensation)
        return replace(pair, lidar=replace(pair.lidar, xyz_m=xyz_m))

    return tuple(of(pair) for pair in pairs)


def _moved(pair: types.FramePair, T_camera_lidar: types.Matrix4, xi: NDArray[np.float64]) -> types.FramePair:
    """The pair as if the mount were moved by ξ (6,) from `T_camera_lidar` (4, 4)."""
    carried = (se3.inverse(se3.perturb(T_camera_lidar, xi)) @ T_camera_lidar).astype(np.float32)
    xyz_m = pair.lidar.xyz_m @ carried[:3, :3].T + carried[:3, 3]
    return replace(pair, lidar=replace(pair.lidar, xyz_m=np.ascontiguousarray(xyz_m)))


def _is_wrong(estimate: types.Estimate, truth: types.Matrix4) -> bool:
    """Judges the rotation alone, because every window has to find it."""
    error = se3.difference(estimate.optimum.T_camera_lidar, truth)
    sigma_rad = float(np.max(estimate.sigma[:3]))
    return bool(np.linalg.norm(error[:3]) > max(WRONG_RAD, WRONG_SIGMAS * sigma_rad))
