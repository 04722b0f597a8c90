"""The jobs of the worker, how they end, what they cost, and how requests and results are packed: plain values that the
submitting side, the queue and the worker share.

Every job ends in exactly one `JobOutcome`: a result, a failure with its reason, superseded by a newer one, or its
deadline has passed.

A request is packed into values that msgpack knows: frames in their native encoding, poses as rows. Frames are not sent
as objects, because the native encoding gives read-only arrays in row-major order, for which the kernels are compiled.

An answer is `{"id": number, "result": {field: value}}` or `{"id": number, "refused": {"code", "text"}}`. A slice of a
commissioning is answered with `{"id": number, "underway": {"stage", "done", "total"}}` until it is complete. A result
has the fields of its dataclass. Arrays are an extension type of their shape and their doubles, so that every bit is
kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

import msgpack
import numpy as np
from cattrs import Converter, override
from numpy.typing import NDArray

from coec.calibration.baseline import BaselineDrift
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.rig.lidar_sampling import LidarRig, RangeBias, SweepPair
from coec.calibration.types import EgoMotion, FramePair, Matrix4, Reason, SweepTiming
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry import se3
from coec.io.converter import MalformedValueError, make_converter, structured
from coec.io.converter import register as register_form
from coec.io.msgpack_frames import decode_camera, decode_ego, decode_lidar, encode
from coec.schemas.message import from_msgpack, to_msgpack

if TYPE_CHECKING:
    from coec.schemas.replies import CalibrationResult
else:
    CalibrationResult = object  # the annotation of a field, which has a rule of its own


T = TypeVar("T")


def pack_pairs(pairs: Sequence[FramePair] | Sequence[SweepPair]) -> Sequence[list[bytes | None]]:
    """Both frames of each pair, and its ego-motion, in native msgpack. Each entry is packed whenever it is read,
    because the pairs of a check have 15 MB and need not be in memory twice."""
    return _PackedLazily(pairs)


class _PackedLazily(Sequence[list[bytes | None]]):
    def __init__(self, pairs: Sequence[FramePair | SweepPair]) -> None:
        self._pairs = tuple(pairs)

    def __len__(self) -> int:
        return len(self._pairs)

    @overload
    def __getitem__(self, index: int) -> list[bytes | None]: ...
    @overload
    def __getitem__(self, index: slice) -> _PackedLazily: ...
    def __getitem__(self, index: int | slice) -> list[bytes | None] | _PackedLazily:
        if isinstance(index, slice):
            return _PackedLazily(self._pairs[index])
        pair = self._pairs[index]
        motion = encode(pair.motion) if pair.motion else None
        if isinstance(pair, FramePair):
            return [encode(pair.camera), encode(pair.lidar), motion]
        return [encode(pair.a), encode(pair.b), motion]


def unpack_pairs(frames: Sequence[Sequence[bytes | None]], limits: LimitsConfig) -> tuple[FramePair, ...]:
    """The pairs that `pack_pairs` packed.

    Raises:
        DecodeError: a frame cannot be decoded.
    """
    return tuple(
        FramePair(decode_camera(camera or b"", limits), decode_lidar(lidar or b"", limits), _motion(motion, limits))
        for camera, lidar, motion in frames
    )


def unpack_sweeps(frames: Sequence[Sequence[bytes | None]], limits: LimitsConfig) -> tuple[SweepPair, ...]:
    """The same for sweeps of two LiDARs.

    Raises:
        DecodeError: a frame cannot be decoded.
    """
    return tuple(
        SweepPair(decode_lidar(a or b"", limits), decode_lidar(b or b"", limits), _motion(motion, limits))
        for a, b, motion in frames
    )


def _motion(packed: bytes | None, limits: LimitsConfig) -> EgoMotion | None:
    return decode_ego(packed, limits) if packed else None


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
        "configuration": configuration.model_dump(mode="json"),
        "pose": pose.tolist(),
        "frames": pack_pairs(pairs),
    }
    return WorkerJob(Kind.CHECK, pair, "check", body, done)


def overlay(pair: str, path: Path, pose: Matrix4, title: str, done: Done, deadline_s: float | None = None) -> WorkerJob:
    """Draws the last pair of a window's file at an extrinsic (4, 4); answered with `RenderedImage`."""
    body = {"path": str(path), "pose": pose.tolist(), "title": title}
    return WorkerJob(Kind.OVERLAY, pair, path.stem, body, done, deadline_s=deadline_s)


def comparison(pair: str, path: Path, poses: tuple[Matrix4, Matrix4], names: tuple[str, str], done: Done) -> WorkerJob:
    """Draws a window's file at two extrinsics (4, 4), where they differ most; `names` are their captions. Answered with
    `RenderedImage`."""
    body = {"path": str(path), "poses": [pose.tolist() for pose in poses], "names": list(names)}
    return WorkerJob(Kind.OVERLAY, pair, path.stem, body, done)


def picture(
    pair: str, configuration: CalibrationConfig, pose: Matrix4, frame_pair: FramePair, title: str, done: Done
) -> WorkerJob:
    """Draws a pair of the stream at an extrinsic (4, 4); answered with `RenderedImage`."""
    body = {
        "configuration": configuration.model_dump(mode="json"),
        "pose": pose.tolist(),
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
        "configuration": configuration.model_dump(mode="json"),
        "pose": pose.tolist(),
        "paths": [str(path) for path in paths],
    }
    return WorkerJob(Kind.COMMISSION, pair, "commissioning", body, done)


def register(edge: str, rig: LidarRig, pairs: Sequence[SweepPair], done: Done) -> WorkerJob:
    """Finds the pose of one LiDAR in another from pairs of their sweeps; answered with `Registered`."""
    body = {"lidars": wire_form().unstructure(rig), "frames": pack_pairs(pairs)}
    return WorkerJob(Kind.REGISTER, edge, "lidars", body, done)


ARRAY = 1
"""Code of the extension type: msgpack of the shape, and the doubles, little-endian, in row-major order."""


class MalformedAnswerError(Exception):
    """An answer is not of the documented form. The message says what is wrong, but quotes none of its values."""


def pack_answer(number: int, answer: Answer | Underway | Reason | None) -> dict[str, Any]:
    """The answer to the question of this number: a result, how far the work is, or why it is refused; None if the
    question asks for nothing."""
    kind = "refused" if isinstance(answer, Reason) else "underway" if isinstance(answer, Underway) else "result"
    return {"id": number, kind: None if answer is None else wire_form().unstructure(answer)}


def number_of(message: Mapping[str, Any]) -> int:
    """The number of the question that is answered.

    Raises:
        MalformedAnswerError: the message has no number.
    """
    number = message.get("id")
    if type(number) is not int:
        raise MalformedAnswerError("it has no number")
    return number


def read_answer(message: Mapping[str, Any], kind: Kind | None) -> Answer | Underway | Reason | None:
    """The answer to a question of a kind, how far its work is, or the reason why there is no answer. None for the kind
    None, which asks for nothing.

    Raises:
        MalformedAnswerError: the message is none of these.
    """
    content = {name: value for name, value in message.items() if name != "id"}
    if content.keys() == {"refused"}:
        return _read(Reason, content["refused"])
    if content.keys() == {"underway"} and kind is Kind.COMMISSION:
        return _read(Underway, content["underway"])
    if content.keys() != {"result"}:
        raise MalformedAnswerError("it is neither a result nor a refusal")
    if kind is not None:
        return _read(ANSWERS[kind], content["result"])
    if content["result"] is not None:
        raise MalformedAnswerError("it is a result for a job that has none")
    return None


def _read(form: type[T], value: Any) -> T:
    """A value of this form, with exactly its fields.

    Raises:
        MalformedAnswerError: it is not in this form.
    """
    try:
        return structured(wire_form(), value, form)
    except MalformedValueError as error:
        raise MalformedAnswerError(f"it is no {form.__name__}: {error}") from error


@cache
def wire_form() -> Converter:
    """The rules by which answers, and the LiDARs of a registration, are packed and read. A result of a window is in
    msgpack, as in the window's file and the history."""
    form = make_converter(forbid_extra_keys=True)
    form.register_structure_hook(float, _read_double)
    form.register_structure_hook(bytes, _read_bytes)
    axes, pose = _doubles(6), _doubles(4, 4, of="finite numbers", accepts=_are_finite)
    register_form(form, SweepTiming)
    register_form(form, LidarRig, T_a_b_nominal=pose, T_a_ego=pose)
    register_form(form, BaselineDrift, value=axes, sigma=axes)
    of_axes = ("offset", "sigma", "noise", "place", "first_derivative", "second_derivative")
    register_form(form, Observation, **dict.fromkeys(of_axes, axes))
    register_form(form, Solved, result=override(struct_hook=_read_result, unstruct_hook=to_msgpack))
    register_form(form, Commissioned, pose=pose)
    covariance = _doubles(6, 6, of="finite numbers", accepts=_are_finite)
    rigid = _doubles(4, 4, of="numbers of a rigid transform", accepts=se3.is_rigid)
    register_form(form, Registered, T_a_b=rigid, covariance=covariance)
    return form


def _read_double(value: Any, _: object) -> float:
    """Any double, NaN and infinity among them."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MalformedValueError("expected a number")
    return float(value)


def _read_bytes(value: Any, _: object) -> bytes:
    if not isinstance(value, bytes):
        raise MalformedValueError("expected bytes")
    return value


def _read_result(value: Any, _: object) -> CalibrationResult:
    # Imported here because the worker imports this module, too, and its first work, a check, needs no wire models.
    from coec.schemas.replies import CalibrationResult

    return from_msgpack(CalibrationResult, value)


def _are_finite(array: NDArray[np.float64]) -> bool:
    return bool(np.isfinite(array).all())


def _doubles(*shape: int, of: str = "numbers", accepts: Callable[[NDArray[np.float64]], bool] = lambda _: True) -> Any:
    """A field that is an array of this shape: an extension type, to the bit."""

    def pack(array: NDArray[np.float64]) -> msgpack.ExtType:
        doubles = np.ascontiguousarray(array, dtype="<f8")
        return msgpack.ExtType(ARRAY, msgpack.packb([doubles.shape, doubles.tobytes()]))

    def read(value: Any, _: object) -> NDArray[np.float64]:
        if not isinstance(value, msgpack.ExtType) or value.code != ARRAY:
            raise MalformedValueError("expected an array")
        packed_shape, doubles = msgpack.unpackb(value.data)
        array = np.frombuffer(doubles, "<f8").reshape(packed_shape).astype(np.float64)
        if array.shape != shape or not accepts(array):
            raise MalformedValueError(f"expected {' × '.join(map(str, shape))} {of}")
        return array

    return override(struct_hook=read, unstruct_hook=pack)


START, IDLE, BACKLOG = "start", "idle", "backlog"
"""Kinds of cost beside the present jobs: a process that starts, a process that waits, windows of an earlier run."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Processor time of all threads of the worker, s.

    Attributes:
        kind: kind of the job, or one of the above, or `prefetch`.
        pair: the pair for which it was spent; empty for none.
        cpu_s: processor time.
    """

    kind: str
    pair: str
    cpu_s: float


def cost_of(work: WorkerJob | Prefetch, cpu_s: float) -> Cost:
    """The cost of a piece of work."""
    if isinstance(work, Prefetch):
        return Cost(PREFETCH, work.pair, cpu_s)
    kind = BACKLOG if work.kind is Kind.SOLVE and not work.live else work.kind.value
    return Cost(kind, work.pair, cpu_s)
