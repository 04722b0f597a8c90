"""Wire models of everything that coec answers, publishes and writes into files.

Conventions: `camera_from_lidar` maps LiDAR coordinates (x forward, y left, z up) to camera coordinates (x right, y
down, z forward). Corrections are about the camera axes. A number that could not be computed is null.
"""

from typing import Annotated, Final, Literal

from pydantic import Field

from coec.schemas.message import Message, Part, Text

Vector3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
Maybe6 = tuple[float | None, float | None, float | None, float | None, float | None, float | None]
Maybe6x6 = tuple[Maybe6, Maybe6, Maybe6, Maybe6, Maybe6, Maybe6]
Flags6 = tuple[bool, bool, bool, bool, bool, bool]
Count = Annotated[int, Field(ge=0)]
Counts = dict[Text, Count]

Provenance = Literal["nominal", "commissioned", "estimated", "restored"]
Status = Literal["not_accepted", "accepted", "failed"]
AxisStatus = Literal["not_solved", "not_observable", "not_accepted", "accepted", "failed"]
Decision = Literal["accepted", "failed"]
StopReason = Literal["tolerance_reached", "optimum_at_bound", "evaluations_exhausted"]
HealthState = Literal["unknown", "healthy", "suspect", "miscalibrated", "degraded", "stale"]

ROS_LEVELS: dict[HealthState, Literal[0, 1, 2, 3]] = {
    "healthy": 0,
    "suspect": 1,
    "degraded": 1,
    "miscalibrated": 2,
    "stale": 3,
    "unknown": 3,
}
"""Level of `diagnostic_msgs/DiagnosticStatus`: 0 OK, 1 WARN, 2 ERROR, 3 STALE. `unknown` is never OK."""

SERVICE_STUCK: Final = "service_stuck"
"""Code of the reason that a reply has not been renewed, so that it may be out of date."""


# --- parts --------------------------------------------------------------------------------------------------


class Transform(Part):
    """A rigid transform in three forms. The matrix is the exact one (float64); the others follow from it."""

    matrix: tuple[Row4, Row4, Row4, Row4] = Field(description="4×4, row-major; translation in m")
    translation_m: Vector3 = Field(description="last column, m")
    quaternion_xyzw: Row4 = Field(description="rotation, unit quaternion, w ≥ 0")


class Intrinsics(Part):
    """Intrinsics of the camera, by the names of the configuration."""

    model: Text = Field(description="model of the lens")
    width: int = Field(description="image width, px")
    height: int = Field(description="image height, px")
    parameters: dict[Text, float] = Field(
        description="fx fy cx cy (px; pixel centres at integers), and the parameters of the model by name"
    )
    sha256: Text | None = Field(
        default=None,
        description="of the canonical JSON of the other fields: names the intrinsics; null: the writer is of an "
        "earlier version",
    )


class LensTerm(Part):
    """A number of the lens, as a difference from the intrinsics of the camera."""

    unit: Literal["px", "share"] = Field(description="`share`: of the value in the intrinsics, 0.01 is 1 %")
    difference: float = Field(description="by the window and by what is known of the intrinsics")
    sigma: float = Field(description="standard deviation of `difference`")
    free_difference: float = Field(description="by the window alone, whatever the intrinsics are")
    free_sigma: float = Field(description="standard deviation of `free_difference`")
    determined: bool = Field(description="whether the window alone determines it")


class Lens(Part):
    """What a window says of the lens. It is reported, and applied by nobody but a person."""

    focal_length: LensTerm
    principal_point_x: LensTerm = Field(description="to the right")
    principal_point_y: LensTerm = Field(description="down")
    radial: LensTerm = Field(description="first radial term: displacement of a corner of the image outwards")
    probability: float = Field(
        description="that the images were taken through another lens than the intrinsics say, 0 to 1"
    )
    estimated: dict[Text, float] = Field(description="fx fy cx cy with these differences, px")


class LensDrift(Lens):
    """The lens according to the latest window, against the configured intrinsics."""

    window_id: Text
    data_stamp_ns: int = Field(description="stamp of the last contributing pair, ns")


class Reason(Part):
    """One reason, for programs and for people."""

    code: Text = Field(description="machine-readable, stable")
    text: Text = Field(description="one sentence for people")


class MetricReply(Part):
    """A figure of self-diagnosis with its limit."""

    value: float | None = Field(description="null if it could not be computed")
    limit: float | None = Field(description="null if there is none")
    at_least: bool = Field(description="true: value ≥ limit is good; false: value ≤ limit is good")
    passed: bool


AXES: Final = ("rx", "ry", "rz", "tx", "ty", "tz")

AxisUnit = Literal["deg", "m"]

UNITS: Final[tuple[AxisUnit, ...]] = ("deg", "deg", "deg", "m", "m", "m")


class AxisReply(Part):
    """One degree of freedom, about or along an axis of the camera."""

    status: AxisStatus = Field(
        description="`not_solved`: not searched; `not_observable`: searched, but the window does not determine it"
    )
    sigma: float | None = Field(description="standard deviation in `unit`; null if not estimated")
    correction: float = Field(description="correction from the nominal calibration, in `unit`")
    unit: AxisUnit


class Axes(Part):
    """All six degrees of freedom: rotation vector (deg), then translation (m)."""

    rx: AxisReply
    ry: AxisReply
    rz: AxisReply
    tx: AxisReply
    ty: AxisReply
    tz: AxisReply


class Verdict(Part):
    """The decision on one result, and why it failed if it did."""

    decision: Decision
    reasons: tuple[Reason, ...] = Field(description="empty if accepted")


# --- one result ---------------------------------------------------------------------------------------------


class MovedWithin(Part):
    """How and when the camera moved while the window was recorded."""

    last_before_ns: int = Field(description="stamp of the last pair that is certainly from before the move, ns")
    first_after_ns: int = Field(description="stamp of the first pair that is certainly from after the move, ns")
    pairs_after: Count = Field(description="pairs of the window after the move; they are kept for the next window")
    before: Transform = Field(
        description="camera_from_lidar that fits the pairs before the move; a rotation is estimated, no translation"
    )
    after: Transform = Field(description="camera_from_lidar that fits the pairs after the move, estimated likewise")


class Cue(Part):
    """What one cue contributed to a result."""

    samples: Count = Field(description="edges of the window, or points in view")
    weight: float = Field(description="of its samples, relative to those of the other kind of edges, 0 to 1")
    significance: float | None = Field(description="of this cue alone at the result, standard deviations")
    share: Maybe6 = Field(
        description="of the curvature of the objective, 0 to 1: rx ry rz tx ty tz; null on axes that were not searched"
    )


class CalibrationResult(Message):
    """The result of calibrating one window; the same in the state, the history, the window's file and `coec
    calibrate`."""

    vehicle: Text
    pair: Text
    camera_frame: Text
    lidar_frame: Text
    window_id: Text
    data_stamp_ns: int = Field(description="stamp of the last contributing pair, ns")
    pairs: Count = Field(description="camera-LiDAR pairs in the window")
    camera_from_lidar: Transform = Field(description="the estimate; served as current only if accepted")
    correction: Vector6 = Field(description="rx ry rz (deg), tx ty tz (m), from the nominal calibration")
    sigma: Maybe6 = Field(description="standard deviations (deg, m); null on axes that are not estimated")
    correction_rad_m: Vector6 = Field(description="`correction` in rad and m, exact")
    noise: Maybe6x6 = Field(
        description="covariance (rad, m), exact, of the errors that differ from window to window; null: unknown"
    )
    systematic: dict[Text, Vector6] = Field(
        description="errors that windows have in common, by name: the shift (rad, m) for one standard deviation"
    )
    correlation_pitch_height: float | None = Field(
        description="correlation of the errors of rx and ty; null if either is unknown"
    )
    correlation_yaw_side: float | None = Field(
        description="correlation of the errors of ry and tx; null if either is unknown"
    )
    independent_looks: float | None = Field(
        description="how many independent samples the pairs are worth: near 1 if the vehicle stood; null: unknown"
    )
    solved: Flags6 = Field(description="axes that the search estimated")
    unobservable: Flags6 = Field(
        description="axes that were searched although the window does not determine them: left as before"
    )
    status: Status
    verdict: Verdict
    metrics: dict[Text, MetricReply] = Field(description="figures of self-diagnosis by name")
    score: float | None = Field(description="objective at the result, in nats; for `fused` in standard deviations")
    score_at_start: float | None = Field(description="objective at the start, in the same unit")
    mi: float | None = Field(description="mutual information at the result, equation (1), nats")
    overlap: float | None = Field(description="share of the guarded points that lie in view, 0 to 1")
    points_in_view: Count = Field(description="LiDAR points in view over all pairs")
    evaluations: Count = Field(description="evaluations of the objective")
    stop_reason: StopReason
    first_derivative: Maybe6 = Field(description="f': d(objective) per rad or m; null on axes not searched")
    second_derivative: Maybe6 = Field(description="f'': -d²(objective) per rad² or m²; null on axes not searched")
    compensation: Counts = Field(description="pairs by outcome of motion compensation")
    depth_identity: Text = Field(description="sha256 of the depth network, or `precomputed`")
    config_hash: Text = Field(description="hash of everything that decides the result")
    moved: MovedWithin | None = Field(
        default=None, description="set if the window was refused because the camera moved within it"
    )
    intrinsics: Intrinsics | None = Field(
        default=None, description="those of the camera that it holds for; null: the writer is of an earlier version"
    )
    lens: Lens | None = Field(
        default=None,
        description="what the window says of the lens; null: the objective uses no edges, or they determine no pose, "
        "or the writer is of an earlier version",
    )
    cues: dict[Text, Cue] | None = Field(
        default=None,
        description="what range_edges, reflectance_edges and depth contributed; null: the objective has one cue only, "
        "or the writer is of an earlier version",
    )


class ProbableMistake(Part):
    """A mistake in the inputs that explains why a result was refused."""

    code: Text = Field(description="machine-readable, for example `inverse_pose`")
    text: Text = Field(description="what is probably wrong, and what to do")
    significance: float | None = Field(
        description="of the edges without the mistake, standard deviations; null: the sizes of images do not match"
    )
    significance_as_given: float | None = Field(description="the same for the inputs as they are")


class WeighedPoses(Part):
    """How many poses a calibration without an initial guess weighed."""

    rotations: int = Field(description="rotations that were compared, with enough of the cloud in view")
    ascended: int = Field(description="local maxima among them that were followed to finer edges")
    ranked: int = Field(description="of these, ranked by edges and depth together")
    solved: int = Field(description="of these, solved as from a start")


class CalibrationReport(CalibrationResult):
    """What `coec calibrate --json` prints: the result and how long it took."""

    elapsed_s: dict[Text, float] = Field(description="by stage, s")
    mistake: ProbableMistake | None = Field(
        default=None, description="probable mistake in the inputs of a refused result"
    )
    recognitions: tuple[Reason, ...] = Field(
        default=(), description="how the recording was read where its values show more than its fields"
    )
    weighed: WeighedPoses | None = Field(
        default=None, description="poses that were weighed without an initial guess; null: there was a start"
    )


# --- replies ------------------------------------------------------------------------------------------------


class Candidate(Part):
    """A result that waits for `apply`."""

    window_id: Text
    sha256: Text | None = Field(
        default=None,
        description="of the window's id, a line feed, and the matrix as 16 little-endian doubles row by row: names the "
        "candidate for `apply`; null: the service is of an earlier version",
    )
    data_stamp_ns: int
    camera_from_lidar: Transform
    step: Vector6 | None = Field(default=None, description="from the served extrinsic: rx ry rz (deg), tx ty tz (m)")
    waits: Reason | None = Field(default=None, description="why it was not applied")


class Hold(Part):
    """A person holds the extrinsic as it is (`command/hold`)."""

    since_ns: int | None = Field(
        description="wall clock of the service, ns since 1970; null: an earlier version held it"
    )
    sender: Text = Field(description="attachment of the command, or the name on a certificate, sanitised")
    reason: Text | None = Field(description="in the sender's words; null if none was given")


class ExtrinsicReply(Message):
    """The calibration to use now. Before the first result it is nominal, not_accepted, 0 %."""

    vehicle: Text
    pair: Text
    camera_frame: Text
    lidar_frame: Text
    camera_from_lidar: Transform = Field(description="current; an unaccepted estimate is never served here")
    cloud_frame: Text | None = Field(
        default=None, description="frame of the points that the driver sends; null if it is `lidar_frame`"
    )
    camera_from_cloud: Transform | None = Field(
        default=None, description="the same calibration for points in `cloud_frame`; null if that is `lidar_frame`"
    )
    provenance: Provenance = Field(description="where `camera_from_lidar` comes from")
    status: Status = Field(description="status of the latest attempt; not_accepted before the first")
    percent_complete: float = Field(ge=0, le=100, description="fill of the open window, %")
    axes: Axes
    correlation_pitch_height: float | None = Field(
        default=None, description="correlation of the errors of rx and ty; null if either is unknown"
    )
    correlation_yaw_side: float | None = Field(
        default=None, description="correlation of the errors of ry and tx; null if either is unknown"
    )
    valid_from_ns: int = Field(description="sensor time from which it holds, ns; 0 for nominal")
    data_stamp_ns: int | None = Field(description="stamp of the last contributing pair, ns; null for nominal")
    window_id: Text | None = Field(description="the window that it comes from; null for nominal")
    config_hash: Text
    pending: Candidate | None = None
    held: bool = Field(default=False, description="frozen by `command/hold`")
    hold: Hold | None = Field(default=None, description="who holds it, since when and why; null if not held")
    intrinsics: Intrinsics | None = Field(
        default=None, description="those of the camera that it holds for; null: the service is of an earlier version"
    )


class DataQuality(Part):
    """Quality of the streams."""

    pair_rate_hz: float | None = Field(default=None, description="camera-LiDAR pairs per second of sensor time")
    sync_error_s: float | None = Field(default=None, description="latest camera stamp minus LiDAR stamp")
    drops: dict[Text, Counts] = Field(default_factory=dict, description="frames lost, by stream, then by cause")
    sharpness: float | None = Field(default=None, description="sharpness of the latest image; falls with blur")
    mean_level: float | None = Field(default=None, description="mean grey value of the latest image, 0 to 255")
    clipped: float | None = Field(default=None, description="share of black or white pixels in the latest image")
    frozen_image: bool = Field(default=False, description="whether the camera repeats the same picture")
    point_times: Text = Field(default="", description="how point times are read, for clouds that leave this open")


class CheckReply(Part):
    """One check of the monitor at the extrinsic served then, and the result of all checks so far."""

    stamp_ns: int = Field(description="stamp of the last pair, ns")
    pair_stamps_ns: tuple[int, ...] = Field(description="stamps of all pairs of the check, ns, ascending")
    flagged: bool = Field(description="the pose is wrong, or the data are")
    undecided: bool = Field(default=False, description="the check neither rejects nor confirms the pose")
    weak: bool = Field(description="the edges are faint, so the check counts less")
    flagged_by_paper: bool | None = Field(
        description="verdict of equation (2), for comparison only; null until the rig is commissioned"
    )
    causes: tuple[Reason, ...] = Field(
        description="what is wrong with the data; a check with a cause is no evidence on the pose"
    )
    metrics: dict[Text, MetricReply] = Field(description="figures of the check by name")
    first_derivative: Maybe6 = Field(description="f' at the pose: dMI, nats per rad or m")
    second_derivative: Maybe6 = Field(description="f'' at the pose: -d²MI, nats per rad² or m²")
    offset: Maybe6 = Field(
        description="from the pose to the estimate of the check, known bias removed (deg, m): rotations from the "
        "optimum over rotations only, translations from the optimum over all axes"
    )
    sigma: Maybe6 = Field(description="standard deviations of `offset` (deg, m)")
    drift: Maybe6 | None = Field(
        description="local optimum from the commissioned extrinsic (deg, m); null before commissioning"
    )
    drift_sigma: Maybe6 | None = Field(description="standard deviations of `drift` (deg, m)")
    outcome: Literal["unknown", "clear", "at_odds", "suspect", "confirmed"] = Field(
        description="result of all checks so far"
    )
    evidence: float = Field(description="evidence of all checks so far for a moved mount: log-likelihood ratio, nats")
    state: HealthState = Field(description="state of the pair after the check")


class Alarms(Part):
    """Outcomes of the alarms of a pair since its state directory was new. The rate of false alarms is `withdrawn`
    over `watched_s`."""

    watched_s: float = Field(ge=0, description="sensor time between completed checks, s")
    confirmed: Count = Field(description="alarms that ended with another extrinsic")
    withdrawn: Count = Field(description="alarms that ended `healthy` with the extrinsic that they had rejected")
    open: bool = Field(description="whether an alarm has not ended yet")


class HealthReply(Message):
    """Whether the calibration is correct. `unknown` means that no check has been made yet."""

    vehicle: Text
    pair: Text
    state: HealthState
    level: Literal[0, 1, 2, 3] = Field(description="ROS: 0 OK, 1 WARN, 2 ERROR, 3 STALE")
    reasons: tuple[Reason, ...]
    metrics: dict[Text, MetricReply] = Field(description="figures of the latest result and the latest check, by name")
    axes: Axes
    drift: Maybe6 | None = Field(
        default=None, description="served extrinsic from the commissioned one (deg, m); null before commissioning"
    )
    drift_sigma: Maybe6 | None = Field(default=None, description="standard deviations of `drift` (deg, m)")
    result_drift: Maybe6 | None = Field(
        default=None, description="latest result, accepted or not, from the commissioned extrinsic (deg, m)"
    )
    result_drift_sigma: Maybe6 | None = Field(default=None, description="standard deviations of `result_drift`")
    check: CheckReply | None = Field(
        default=None, description="the latest check; null if none was made at the served extrinsic"
    )
    needs: tuple[Text, ...] = Field(description="what is missing, one sentence each")
    data_quality: DataQuality
    since_ns: int = Field(description="wall clock when this state began, ns since 1970")
    evaluated_ns: int | None = Field(description="stamp of the last evaluated pair, ns; null before the first window")
    age_s: float | None = Field(description="age of the last evaluated window; null before the first")
    alarms: Alarms | None = Field(default=None, description="its alarms by outcome; null while the pair is incomplete")
    intrinsics: LensDrift | None = Field(
        default=None,
        description="drift of the lens of the latest window from the configured intrinsics; null: no window tells",
    )


Book = Literal["results", "states", "commands"]
"""A part of the history, with a quota of its own."""


class HistoryEntry(Message):
    """A line of a book of the append-only history. Its sha256 is taken over its own canonical JSON. The next entry of
    the book holds it as `previous_sha256`, so that a changed, removed or inserted entry shows."""

    sequence: Count = Field(description="number of the entry among all books of the pair, from 0")
    book: Book = Field(default="results", description="chain that the entry belongs to; each has a quota of its own")
    previous_sha256: Text = Field(
        description="sha256 of the previous entry in the book, hexadecimal; 64 zeros for the first"
    )
    kind: Literal["estimate", "extrinsic", "state", "command", "commissioned", "chain"]
    code: Text = Field(description="machine-readable: decision, provenance, state, or outcome of the command")
    text: Text = Field(description="one sentence")
    wall_ns: int = Field(description="wall clock of the service, ns since 1970")
    stamp_ns: int | None = Field(default=None, description="sensor time of the data behind it, ns")
    window_id: Text | None = None
    sender: Text | None = Field(default=None, description="attachment of a command, sanitised")
    reason: Text | None = Field(default=None, description="reason for a command, in the sender's words")
    camera_from_lidar: Transform | None = Field(default=None, description="what is served from here on (`extrinsic`)")
    result_sha256: Text | None = Field(
        default=None, description="sha256 of the canonical JSON of the result (`estimate`)"
    )


class ChainedEntry(Part):
    """An entry of the history with its own sha256, by which `command/rollback` can name it."""

    sha256: Text
    entry: HistoryEntry


class HistoryReply(Message):
    """Past results and what else happened, oldest first."""

    vehicle: Text
    pair: Text
    total: Count = Field(description="results stored, before the selector is applied")
    results: tuple[CalibrationResult, ...]
    entries: tuple[ChainedEntry, ...] = Field(
        default=(), description="entries of all books; results stand here without their bodies"
    )
    checks: tuple[CheckReply, ...] = Field(default=(), description="stored checks of the monitor")


class MetricsPoint(Part):
    """The figures of the monitor at one check."""

    stamp_ns: int
    state: HealthState
    metrics: dict[Text, float | None]


class EvidenceEvent(Message):
    """What is stored of an incident: windows before and after, pictures, figures around it, and how it ended."""

    event_id: Text
    vehicle: Text
    pair: Text
    stamp_ns: int = Field(description="sensor time of the data that decided, ns")
    wall_ns: int = Field(description="wall clock, ns since 1970")
    reasons: tuple[Reason, ...]
    camera_from_lidar: Transform = Field(description="what was served then")
    window_before: Text | None = Field(description="the last window before the event; null if there is none")
    window_after: Text | None = Field(default=None, description="the first window after it; null until there is one")
    overlays: tuple[Literal["before", "after"], ...] = Field(default=(), description="the stored pictures")
    metrics: tuple[MetricsPoint, ...] = Field(description="figures around the event, oldest first")
    resolved_stamp_ns: int | None = Field(default=None, description="sensor time at which the red state ended, ns")
    resolution: Text | None = Field(default=None, description="how it ended, one sentence; null while it is red")


class EvidenceReply(Message):
    """The stored incidents, oldest first, without their figures."""

    vehicle: Text
    pair: Text
    events: tuple[EvidenceEvent, ...]


RetentionReason = Literal["red_event", "commissioning"]


class WindowInfo(Part):
    """One recorded window."""

    window_id: Text
    sha256: Text | None = Field(
        description="hash of the whole file, hexadecimal; null until the service has read this version of it"
    )
    size_bytes: Count
    pairs: Count | None = Field(description="null until the file was read, or if it cannot be read")
    decision: Decision | None = Field(description="null while it is not evaluated, or `sha256` is null")
    kept_for: RetentionReason | None = Field(
        default=None, description="why it is removed after others when space is freed; null: it is removed in turn"
    )


class SnippetInfo(Part):
    """A full-rate recording of the seconds around an event; `windows/<snippet_id>` gives its bytes."""

    snippet_id: Text
    event: Text = Field(description="state of health that was entered; empty if the file does not say")
    stamp_ns: int = Field(description="sensor time of the last frame before the event was reported, ns")
    recorded_ns: int = Field(description="wall clock when it was on the disk, ns")
    size_bytes: Count
    sha256: Text = Field(description="hash of the whole file, hexadecimal")


class WindowsReply(Message):
    """Recorded windows, oldest first."""

    vehicle: Text
    pair: Text
    windows: tuple[WindowInfo, ...]
    snippets: tuple[SnippetInfo, ...] = Field(default=(), description="oldest first")


class StreamStatus(Part):
    """Counters of one stream since the daemon started."""

    received: Count = 0
    accepted: Count = 0
    waiting: Count = Field(default=0, description="received samples that are not decoded yet")
    age_s: float | None = Field(default=None, ge=0, description="time since the last sample, s; null before the first")
    losses: Counts = Field(default_factory=dict, description="lost samples by cause")


class PairStatus(Part):
    """One camera-LiDAR pair."""

    name: Text
    camera: StreamStatus = StreamStatus()
    lidar: StreamStatus = StreamStatus()
    ego: StreamStatus | None = Field(default=None, description="null if no ego-motion is configured")
    pairs: Count = Field(default=0, description="pairs formed")
    held: Count = Field(default=0, description="pairs that wait for the evaluation of earlier frames")
    unanswered: Count = Field(default=0, description="checks and windows without a result yet")
    selected: Count = Field(default=0, description="pairs selected for the open window")
    unwritten: Count = Field(default=0, description="selected pairs that wait for the disk")
    rejections: Counts = Field(default_factory=dict, description="pairs not selected, by cause")
    losses: Counts = Field(default_factory=dict, description="frames without a partner, and lost windows, by cause")
    windows: Count = Field(default=0, description="windows recorded")
    solved: Count = Field(default=0, description="windows evaluated")
    checks: Count = Field(default=0, description="checks of the monitor at the served extrinsic")
    transitions: Counts = Field(default_factory=dict, description="changes of health, by the new state")
    commands: Counts = Field(default_factory=dict, description="commands, by name and outcome")
    awaits: tuple[Reason, ...] = Field(
        default=(), description="what the configuration leaves out and the service has not discovered yet"
    )
    found: dict[Text, Text] = Field(
        default_factory=dict,
        description="sources of the values that the configuration leaves out, by key of the configuration",
    )


class CompilingStatus(Part):
    """The compilation of the worker's kernels, which happens once on a machine."""

    done: Count = Field(description="compiled kernels")
    total: Count = Field(description="kernels that the configuration needs")
    elapsed_s: float = Field(ge=0, description="time since the first was begun, s")


class WorkerStatus(Part):
    """The process that runs the depth network and solves windows."""

    state: Literal["starting", "idle", "busy", "stopped"]
    pid: int | None = None
    compiling: CompilingStatus | None = Field(default=None, description="null while no kernel is being compiled")
    restarts: Count = 0
    queued: Count = Field(default=0, description="jobs that wait")
    waiting: Counts = Field(
        default_factory=dict, description="jobs that wait, by kind; `backlog`: windows of an earlier run"
    )
    job: Text | None = Field(default=None, description="kind of the job that the worker runs; null if none")
    job_age_s: float | None = Field(default=None, ge=0, description="how long the worker has run this job, s")
    commissioning: dict[Text, Text] = Field(
        default_factory=dict,
        description="progress of the commissioning of each pair that has one, such as `spread 4 of 10`",
    )
    outcomes: Counts = Field(
        default_factory=dict, description="ended jobs by outcome: result, failed, superseded, deadline_passed"
    )
    losses: Counts = Field(
        default_factory=dict, description="jobs without a result, and dropped inferences made ahead, by cause"
    )
    faults: Counts = Field(default_factory=dict, description="worker processes that were replaced, by cause")


class BudgetShare(Part):
    """The share of one pair in the budget."""

    look_s: float | None = Field(ge=0, description="cost of a check, s of processor time; null before the first")
    window_s: float | None = Field(
        ge=0,
        description="cost of a window, with the depth of its images, s of processor time; null before the first",
    )
    unseen_s: float | None = Field(
        ge=0, description="time since the worker last checked the pair, s; null before the first check"
    )
    suspected: bool = Field(description="the pair is suspected: its checks come first and may borrow")
    waiting: bool = Field(description="a check waits for budget")
    active: bool = Field(description="its streams provide frame pairs for checks")


class BudgetStatus(Part):
    """How much processor time all pairs together spend, in cores: s of processor time per second."""

    cores: float = Field(description="what checks and windows may spend, per second of sensor time")
    spent: float = Field(
        ge=0,
        description="what the worker spent on all work in the last three minutes, per second of the monotonic clock",
    )
    wanted: float = Field(ge=0, description="what all checks and windows of all active pairs would need")
    stretched_by: float = Field(
        ge=1, description="factor by which periods of checks and slices of windows are longer than configured"
    )
    in_store_s: float = Field(description="processor time in the token bucket, s; below 0: borrowed for a suspicion")
    spent_s: dict[Text, float] = Field(
        description="processor time of the worker since the start by purpose, s: check, solve, prefetch (depth for a "
        "window), start, idle, backlog, overlay, picture, commission"
    )
    pairs: dict[Text, BudgetShare]


class StorageStatus(Part):
    """The state directory."""

    bytes_used: Count
    bytes_free: Count
    losses: Counts = Field(default_factory=dict, description="losses by cause")


class ConfigurationStatus(Part):
    """Result of the last reading of the configuration file: at the start, or on SIGHUP."""

    read_ns: int = Field(description="wall clock when it was read, ns since 1970")
    reloads: Count = Field(default=0, description="how often it was read again and applied, wholly or in part")
    taken: tuple[Text, ...] = Field(default=(), description="keys whose new values are in force since then")
    waiting: tuple[Text, ...] = Field(default=(), description="keys whose new values wait for a restart")
    refused: Text | None = Field(
        default=None, description="why the file on the disk was refused; then the earlier values stay in force"
    )


class StatusReply(Message):
    """Status of the daemon."""

    version: Text
    vehicle: Text
    state: Literal["starting", "running", "stopping", "failing"]
    reasons: tuple[Reason, ...] = ()
    started_ns: int = Field(description="wall clock, ns since 1970")
    uptime_s: float
    config_hash: Text = Field(description="hash of the configuration in effect, reloads included")
    configuration: ConfigurationStatus | None = Field(default=None, description="null from an older service")
    pairs: tuple[PairStatus, ...]
    worker: WorkerStatus
    budget: BudgetStatus | None = Field(default=None, description="null from an older service")
    storage: StorageStatus
    queries_waiting: Counts = Field(default_factory=dict, description="queries that wait for an answer, by queue")


class ErrorReply(Message):
    """Payload of an error reply."""

    code: Text
    message: Text
