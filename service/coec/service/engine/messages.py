"""What comes into the state machine of a pair, and what goes out of it: events and actions, plain values.

An action says what is to be done outside; who does it is `camera_lidar_pair.CameraLidarPair`. An action for the worker
carries the subject of the event by which its outcome comes back.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coec.calibration.baseline import BaselineDrift
from coec.calibration.frames.window import CarriedOverPairs, SliceClosed
from coec.calibration.state import PairState
from coec.calibration.types import CameraFrame, FramePair, Matrix4, Reason
from coec.config import CalibrationConfig, PairConfig
from coec.schemas.replies import CheckReply
from coec.service.engine.rig import PairCorrection
from coec.service.engine.schedule import Request, Schedule
from coec.service.ingest.pair_stream import StreamStatistics
from coec.service.recording.recorder import RecordBetween, RecordPair, WindowLost, WindowRecorded
from coec.service.records.incidents import Side
from coec.service.records.pair_store import ServedExtrinsic
from coec.service.worker.worker_jobs import JobOutcome


@dataclass(frozen=True, slots=True)
class CheckSubject:
    """A check of the extrinsic of `epoch`. `standing_ns`: stamps of its frame pairs that were taken while the vehicle
    stood."""

    epoch: int
    standing_ns: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class WindowSubject:
    """The window that ended last, or one that is solved again. `live` is False for a window of an earlier run."""

    window_id: str
    live: bool = True


@dataclass(frozen=True, slots=True)
class PictureSubject:
    """A picture for the evidence of an incident."""

    event_id: str
    side: Side


@dataclass(frozen=True, slots=True)
class CommissioningSubject:
    """The baseline of the rig is learned from these windows."""

    window_ids: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SelectionChange:
    """What a result changes in the selection of frames, from the sensor time on at which it counts.

    Attributes:
        served: the extrinsic at which frame pairs are evaluated.
        is_calm: no window is wanted soon any more.
        urgent_since_ns: a window of frame pairs since this sensor time is wanted soon.
        carried_over: frame pairs of a window that belong to the next one.
        calibration: the configuration for windows that begin from then on.
    """

    served: ServedExtrinsic | None = None
    is_calm: bool = False
    urgent_since_ns: int | None = None
    carried_over: CarriedOverPairs | None = None
    calibration: CalibrationConfig | None = None


PairResult = JobOutcome | PairCorrection | Reason
"""The result of a request: of the worker, of the rig, or why there is none."""

PairSubject = CheckSubject | WindowSubject | PairCorrection
PairRequest = Request[PairSubject, PairResult, SelectionChange]
PairSchedule = Schedule[PairSubject, PairResult, SelectionChange]


@dataclass(frozen=True, slots=True)
class PairSnapshot:
    """Everything that is known of a pair at one moment, from which its answers are made.

    Attributes:
        state: state of the pair.
        served: the extrinsic that is served.
        check: the latest check of that extrinsic.
        problems: problems of the service itself, or that the extrinsic is on hold.
        drift, result_drift: drift of the served extrinsic and of the latest result from the commissioned one; None
            before commissioning.
        since_ns: wall clock when the state of health began.
        completed_stamp_ns, age_s: sensor time and age of the last completed check; None if unknown.
        checks, solved: number of completed checks and of solved windows.
        transitions: number of changes of health, by the state that was entered.
    """

    state: PairState
    served: ServedExtrinsic
    check: CheckReply | None
    problems: tuple[Reason, ...]
    drift: BaselineDrift | None
    result_drift: BaselineDrift | None
    since_ns: int
    completed_stamp_ns: int | None
    age_s: float | None
    checks: int
    solved: int
    transitions: tuple[tuple[str, int], ...]


JobSubject = Request[Any, Any, Any] | WindowSubject | PictureSubject | CommissioningSubject
"""What a job of the worker is about: a request of a schedule (a check, a registration), or one of the others."""

# --- events ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SensorTime:
    """The streams of the pair have come to this sensor time."""

    stamp_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Evaluate:
    """The next frame pair is to be evaluated, after `SensorTime` of its stamp. `is_forced`: although a result that
    counts before it is missing, because it cannot wait longer."""

    pair: FramePair
    is_forced: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class JobDone:
    """A job of the worker has ended."""

    subject: JobSubject
    outcome: JobOutcome


@dataclass(frozen=True, slots=True)
class Tick:
    """The clocks have moved.

    Attributes:
        uncounted_s: time so far that does not count as waiting for a result, s: that in which kernels were compiled.
        statistics: statistics of the streams.
    """

    uncounted_s: float
    statistics: StreamStatistics


@dataclass(frozen=True, slots=True)
class Reconfigured:
    """Other settings hold from now on, which differ only in what `configuration.RELOADED` names. `history_text` is the
    entry for the history."""

    pair: PairConfig
    stale_after_s: float
    history_text: str


Event = SensorTime | Evaluate | JobDone | WindowRecorded | WindowLost | Tick | Reconfigured
"""What comes into a pair."""

# --- actions --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class UseCalibration:
    """Windows that begin from now on are solved by this configuration."""

    calibration: CalibrationConfig


@dataclass(frozen=True, slots=True, eq=False)
class Prefetch:
    """The depth of a camera frame will be needed."""

    camera: CameraFrame


@dataclass(frozen=True, slots=True, eq=False)
class SubmitCheck:
    """Whether the served extrinsic is right according to these frame pairs is to be checked."""

    request: PairRequest
    pairs: tuple[FramePair, ...]
    served: ServedExtrinsic
    calibration: CalibrationConfig


@dataclass(frozen=True, slots=True)
class SubmitSolve:
    """A window on the disk is to be solved."""

    subject: WindowSubject
    path: Path


@dataclass(frozen=True, slots=True, eq=False)
class SubmitPicture:
    """A window is to be rendered at each of these extrinsics (4, 4), with their captions."""

    subject: PictureSubject
    window_id: str
    poses: tuple[Matrix4, ...]
    captions: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SubmitCommissioning:
    """The baseline of the rig is to be learned at an extrinsic (4, 4)."""

    subject: CommissioningSubject
    pose: Matrix4
    calibration: CalibrationConfig


@dataclass(frozen=True, slots=True, eq=False)
class KeepSnippet:
    """The seconds around an event are to be kept; `T_camera_lidar` (4, 4) is served then."""

    event: str
    T_camera_lidar: Matrix4


@dataclass(frozen=True, slots=True)
class Publish:
    """What is known is to be served and published."""

    snapshot: PairSnapshot


Action = (
    RecordPair
    | RecordBetween
    | SliceClosed
    | UseCalibration
    | Prefetch
    | SubmitCheck
    | SubmitSolve
    | SubmitPicture
    | SubmitCommissioning
    | KeepSnippet
    | Publish
)
"""What a pair wants done; a `SliceClosed` ends the window that is being recorded."""
