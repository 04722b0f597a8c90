"""The questions to the worker, and how they end: plain values that the asking side, the queue and the worker share.

Every job ends in exactly one `JobOutcome`: a result, a failure with its reason, superseded by a newer one, or its
deadline has passed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coec.calibration.lidar_to_lidar.types import LidarRig, RangeBias, SweepPair
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.types import FramePair, Matrix4, Reason
from coec.config import CalibrationConfig
from coec.runtime.worker.messages import pack_lidars, pack_pairs, pack_pose, pack_sweeps

if TYPE_CHECKING:
    from coec.schemas.replies import CalibrationResult


class Kind(StrEnum):
    """What may be asked."""

    SOLVE = "solve"
    CHECK = "check"
    OVERLAY = "overlay"
    PICTURE = "picture"
    COMMISSION = "commission"
    REGISTER = "register"


PREFETCH = "prefetch"
"""Kind of the messages that are no job, see `Prefetch`."""


class Fate(StrEnum):
    """How a question ends."""

    RESULT = "result"
    FAILED = "failed"
    SUPERSEDED = "superseded"
    LATE = "deadline_passed"


DEADLINE_S = {
    Kind.SOLVE: 600.0,
    Kind.CHECK: 180.0,
    Kind.OVERLAY: 60.0,
    Kind.PICTURE: 60.0,
    Kind.COMMISSION: 7200.0,
    Kind.REGISTER: 180.0,
}
"""Time from asking until an answer is given up, s. For a live window: two attempts of 120 s, which `worker` allows by
default, after another window that needs as long, and two minutes for new processes. For a check, and for the
registration of two LiDARs: the start of a worker on a busy machine, and a solve before it. For a picture: six solves of
10 s. For a commissioning: those of eight pairs at once, of three minutes each, when checks and windows, which go first,
leave a fifth of the worker's time. One slice of it may take no longer than any other job (`worker.timeout_s`). The time
in which the worker compiles kernels does not count."""

BACKLOG_DEADLINE_S = 86_400.0
"""The same for a window of an earlier run, s: it waits behind everything else, and is asked for again after the next
start."""

_COMMISSIONINGS = count()
"""Numbers the commissionings, so that the worker recognises the one that it has begun."""


@dataclass(frozen=True, slots=True)
class WrittenFile:
    """A window's file as it was written: its size, the time of its last write, its hash, the number of its pairs."""

    size_bytes: int
    modified_ns: int
    sha256: str
    pairs: int


@dataclass(frozen=True, slots=True)
class Solved:
    """A window was calibrated. If its file holds the result, `written` is that file; else `note` says why it does
    not."""

    result: CalibrationResult
    note: Reason | None
    written: WrittenFile | None = None


@dataclass(frozen=True, slots=True)
class Checked:
    """The monitor looked at some pairs. `baseline_not_used` says why the rig's baseline was not used, if there is
    one."""

    observation: Observation
    baseline_not_used: str | None


@dataclass(frozen=True, slots=True)
class RenderedImage:
    """A picture, JPEG."""

    jpeg: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Commissioned:
    """A baseline was learned and is on the disk; `windows` and `pairs` say from how many. `pose` (4, 4) maps LiDAR to
    camera."""

    pose: Matrix4
    baseline_hash: str
    windows: int
    pairs: int


@dataclass(frozen=True, slots=True)
class Underway:
    """A commissioning is not complete: the worker has done a slice of it, up to `done` of `total` parts of a stage, and
    is free for other work. It goes on when the same job is sent again."""

    stage: str
    done: int
    total: int

    def __str__(self) -> str:
        return f"{self.stage} {self.done} of {self.total}"


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """Two LiDARs a and b were registered; the fields are those of `LidarEdge`."""

    T_a_b: Matrix4
    covariance: NDArray[np.float64]
    range_bias: RangeBias
    rms_m: float
    points: int
    share: float
    pairs: int
    reasons: tuple[Reason, ...]


Answer = Solved | Checked | RenderedImage | Commissioned | Registered

ANSWERS: dict[Kind, type[Answer]] = {
    Kind.SOLVE: Solved,
    Kind.CHECK: Checked,
    Kind.OVERLAY: RenderedImage,
    Kind.PICTURE: RenderedImage,
    Kind.COMMISSION: Commissioned,
    Kind.REGISTER: Registered,
}
"""The type of the answer to each kind."""


@dataclass(frozen=True, slots=True, eq=False)
class JobOutcome:
    """The end of a job.

    Attributes:
        fate: how the job ended.
        answer: the answer; None exactly if there is no result.
        reason: why there is no result; None exactly if there is one.
        elapsed_s: time since asking, s.
    """

    fate: Fate
    answer: Answer | None
    reason: Reason | None
    elapsed_s: float

    def __post_init__(self) -> None:
        """Checks that the fields fit each other.

        Raises:
            ValueError: there is neither an answer nor a reason, or both, or the one that does not fit the fate.
        """
        if (self.answer is not None) is not (self.fate is Fate.RESULT) or (self.reason is None) is (
            self.answer is None
        ):
            raise ValueError(f"an outcome with the fate {self.fate!r} has either an answer or a reason")


@dataclass(frozen=True, slots=True, eq=False)
class WorkerJob:
    """One question to the worker. The functions below make them.

    Attributes:
        kind: what is asked.
        pair: the pair for which it is asked.
        subject: id of a window, or a word, for logs and status.
        body: input of the work, in values that msgpack knows or lazy sequences of them. If the job is sent at most
            once, the body is emptied after sending.
        done: called once with the outcome, with no lock held, on the supervisor's thread or on the one that asks or
            stops.
        live: False for a window left over from an earlier run.
        deadline_s: time since asking after which the job is answered `LATE`; None: the default of its kind.
        timeout_s: time after which a worker with this job is replaced; None: `worker.timeout_s`.
    """

    kind: Kind
    pair: str
    subject: str
    body: dict[str, Any]
    done: Callable[[JobOutcome], None]
    live: bool = True
    deadline_s: float | None = None
    timeout_s: float | None = None

    @property
    def patience_s(self) -> float:
        """How long to wait for the answer, s."""
        if self.deadline_s is not None:
            return self.deadline_s
        return DEADLINE_S[self.kind] if self.live else BACKLOG_DEADLINE_S


@dataclass(frozen=True, slots=True)
class Prefetch:
    """Depth inference of a camera frame (native msgpack) ahead of its use. It is no job: nobody waits for it."""

    pair: str
    frame: bytes


Done = Callable[[JobOutcome], None]


def solve(pair: str, path: Path, window_id: str, done: Done, live: bool = True) -> WorkerJob:
    """Calibrates the file of a finished window and writes the result into it; answered with `Solved`."""
    return WorkerJob(Kind.SOLVE, pair, window_id, {"path": str(path)}, done, live)


def check(
    pair: str, configuration: CalibrationConfig, pose: Matrix4, pairs: Sequence[FramePair], done: Done
) -> WorkerJob:
    """Has the monitor look at pairs at an extrinsic (4, 4); answered with `Checked`. The question brings the
    configuration of the moment at which it is asked, whatever the worker was started with."""
    body = {
        "configuration": _configuration_document(configuration),
        "pose": pack_pose(pose),
        "frames": pack_pairs(pairs),
    }
    return WorkerJob(Kind.CHECK, pair, "check", body, done)


def overlay(pair: str, path: Path, pose: Matrix4, title: str, done: Done, deadline_s: float | None = None) -> WorkerJob:
    """Draws the last pair of a window's file at an extrinsic (4, 4); answered with `Drawn`."""
    body = {"path": str(path), "pose": pack_pose(pose), "title": title}
    return WorkerJob(Kind.OVERLAY, pair, path.stem, body, done, deadline_s=deadline_s)


def comparison(pair: str, path: Path, poses: tuple[Matrix4, Matrix4], names: tuple[str, str], done: Done) -> WorkerJob:
    """Draws a window's file at two extrinsics (4, 4), where they differ most; `names` are their captions. Answered with
    `Drawn`."""
    body = {"path": str(path), "poses": [pack_pose(pose) for pose in poses], "names": list(names)}
    return WorkerJob(Kind.OVERLAY, pair, path.stem, body, done)


def picture(
    pair: str, configuration: CalibrationConfig, pose: Matrix4, frame_pair: FramePair, title: str, done: Done
) -> WorkerJob:
    """Draws a pair of the stream at an extrinsic (4, 4); answered with `Drawn`."""
    body = {
        "configuration": _configuration_document(configuration),
        "pose": pack_pose(pose),
        "frames": pack_pairs([frame_pair]),
        "title": title,
    }
    return WorkerJob(Kind.PICTURE, pair, "picture", body, done)


def commission(
    pair: str, configuration: CalibrationConfig, pose: Matrix4, paths: Sequence[Path], done: Done
) -> WorkerJob:
    """Learns the rig's baseline at an extrinsic (4, 4) from windows' files; answered with `Commissioned`. It takes
    minutes, so it is done in slices: the worker answers `Underway` until it is complete."""
    body = {
        "run": next(_COMMISSIONINGS),
        "configuration": _configuration_document(configuration),
        "pose": pack_pose(pose),
        "paths": [str(path) for path in paths],
    }
    return WorkerJob(Kind.COMMISSION, pair, "commissioning", body, done)


def register(edge: str, rig: LidarRig, pairs: Sequence[SweepPair], done: Done) -> WorkerJob:
    """Finds the pose of one LiDAR in another from pairs of their sweeps; answered with `Registered`."""
    body = {"lidars": pack_lidars(rig), "frames": pack_sweeps(pairs)}
    return WorkerJob(Kind.REGISTER, edge, "lidars", body, done)


def _configuration_document(configuration: CalibrationConfig) -> dict[str, Any]:
    return configuration.model_dump(mode="json")
