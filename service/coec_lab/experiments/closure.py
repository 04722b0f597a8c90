"""Do two calibrations close? Two cameras, or two LiDARs, are each calibrated by themselves and compared through the
known pose between them. The test needs no reference for either.

Two cameras A and B beside one LiDAR: T_B_A · T_A_lidar should be T_B_lidar. Two LiDARs beside one camera: T_camera_A ·
T_B_A⁻¹ should be T_camera_B. The difference is the closure error, ξ about the axes of camera B.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4, Rig
from coec.errors import UsageError
from coec.geometry import se3
from coec_lab.experiments import solve_statistics
from coec_lab.experiments.solve_statistics import (
    NormalisedErrors,
    SolveOutcome,
    SpreadStatistics,
    carried,
    claimed,
    gathered,
    normalise,
)


class Relation(StrEnum):
    """What two rigs have in common."""

    CAMERAS = "two cameras, one LiDAR"
    LIDARS = "two LiDARs, one camera"


class FrameChoice(StrEnum):
    """On which frames both are calibrated."""

    ALL = "all frames"
    SHARED = "the same half"
    DISJOINT = "other halves"


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """The known pose between two sensors: T_b_a (4, 4) maps coordinates of sensor A to those of sensor B."""

    relation: Relation
    T_b_a: Matrix4

    def predicted(self, T_of_a: Matrix4) -> Matrix4:
        """B's calibration (4, 4) as it should be, given that of A."""
        if self.relation is Relation.CAMERAS:
            return np.asarray(self.T_b_a @ T_of_a)
        return np.asarray(T_of_a @ se3.inverse(self.T_b_a))

    @property
    def jacobian(self) -> NDArray[np.float64]:
        """(6, 6) how an error of A's calibration carries over to the prediction for B, about the axes of camera B."""
        return se3.adjoint(self.T_b_a) if self.relation is Relation.CAMERAS else np.eye(6)

    def error(self, a: SolveOutcome, b: SolveOutcome) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """ξ (6,) from what A predicts to what B found, and its covariance (6, 6) by both claims; None unless both were
        accepted and claim something."""
        of_a, of_b = claimed(a), claimed(b)
        if of_a is None or of_b is None:
            return None
        error = se3.difference(b.T_camera_lidar, self.predicted(a.T_camera_lidar))
        return error, of_b + carried(of_a, self.jacobian)


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """How solves of A and B close, on some frames.

    Attributes:
        frames: on which both were calibrated.
        pairs: camera-LiDAR pairs in each solve of A and of B.
        normalised: the closure errors divided by what was claimed for them.
        rotation_rad, translation_m: sizes of the errors; NaN for a translation that was not searched.
    """

    frames: FrameChoice
    pairs: tuple[int, int]
    normalised: NormalisedErrors
    rotation_rad: SpreadStatistics
    translation_m: SpreadStatistics


Solve = Callable[[int, Sequence[int] | None], SolveOutcome]
"""Solves from the start of a trial, on the frames of the given indices (None: all of them)."""


def between(a: Rig, b: Rig, T_b_a: Matrix4 | None) -> Between:
    """The pose between the sensors of two rigs: T_b_a (4, 4), or what their own calibrations say.

    Raises:
        UsageError: the rigs share neither LiDAR nor camera.
    """
    if a.lidar_frame == b.lidar_frame:
        relation = Relation.CAMERAS
        recorded = b.T_camera_lidar_nominal @ se3.inverse(a.T_camera_lidar_nominal)
    elif a.camera_frame == b.camera_frame:
        relation = Relation.LIDARS
        recorded = se3.inverse(b.T_camera_lidar_nominal) @ a.T_camera_lidar_nominal
    else:
        raise UsageError(
            f"--closure: the sources share neither LiDAR ({a.lidar_frame}, {b.lidar_frame}) nor camera "
            f"({a.camera_frame}, {b.camera_frame}): give two cameras beside one LiDAR, or two LiDARs beside one camera"
        )
    return Between(relation, np.asarray(recorded) if T_b_a is None else T_b_a)


def close(
    known: Between,
    solve_a: Solve,
    solve_b: Solve,
    pairs: tuple[int, int],
    trials: int,
    dof: int,
    on_progress: Callable[[int, str], None],
) -> tuple[Closure, ...]:
    """Calibrates A and B by themselves, `trials` times from different starts: on all their frames (`pairs` of each), on
    the same half, and on halves that have no instant in common.

    Halves are drawn by index: two sources share instants if they have equal numbers of frames taken together.
    """
    outcomes_by_frames: dict[FrameChoice, list[tuple[SolveOutcome, SolveOutcome]]] = {
        frames: [] for frames in FrameChoice
    }
    halved = min(pairs) >= 2
    for trial in range(trials):
        outcomes_by_frames[FrameChoice.ALL].append((solve_a(trial, None), solve_b(trial, None)))
        if halved:
            one, other = solve_statistics.split(min(pairs), trial)
            a = solve_a(trial, one)
            outcomes_by_frames[FrameChoice.SHARED].append((a, solve_b(trial, one)))
            outcomes_by_frames[FrameChoice.DISJOINT].append((a, solve_b(trial, other)))
        on_progress(trial + 1, "")
    half = (min(pairs) // 2, min(pairs) // 2)
    return tuple(
        _closure(known, frames, pairs if frames is FrameChoice.ALL else half, outcomes, dof)
        for frames, outcomes in outcomes_by_frames.items()
        if outcomes
    )


def _closure(
    known: Between,
    frames: FrameChoice,
    pairs: tuple[int, int],
    outcomes: Sequence[tuple[SolveOutcome, SolveOutcome]],
    dof: int,
) -> Closure:
    results = [known.error(a, b) for a, b in outcomes]
    errors = [result[0] for result in results if result is not None]
    return Closure(
        frames=frames,
        pairs=pairs,
        # All trials see the same recording, so they count as one.
        normalised=normalise(gathered(results), independent=1),
        rotation_rad=solve_statistics.spread(float(np.linalg.norm(error[:3])) for error in errors),
        translation_m=solve_statistics.spread(float(np.linalg.norm(error[3:])) for error in errors if dof == 6),
    )
