"""Documents of `coec evaluate --json` and `coec models assess --json`.

Angles in degrees, lengths in metres, axes rx ry rz tx ty tz about and along the camera axes. A number that could not be
computed is null.
"""

from typing import Literal

from pydantic import Field

from coec.schemas.message import Message, Part, Text
from coec.schemas.replies import Count, Counts, Maybe6, Vector3, Vector6


class Spread(Part):
    """Spread of a figure over the starts; null if it could not be computed."""

    median: float | None
    p95: float | None = Field(description="95th percentile, interpolated linearly")
    max: float | None


class VerdictCounts(Part):
    """Number of starts by the verdict and by the truth."""

    accepted_hits: Count
    accepted_misses: Count = Field(description="the dangerous ones: wrong, but would be served")
    failed_hits: Count
    failed_misses: Count


class FramesPoint(Part):
    """Errors over several subsets with one number of frames, hits and misses alike."""

    frames: Count
    subsets: Count
    hit_rate: float
    rotation_deg: Spread
    translation_m: Spread
    sigma_deg: float | None = Field(description="standard deviation of the rotation that the solves claim, median")


class SlicePoint(Part):
    """Errors over several slices of one length, hits and misses alike."""

    length_s: float = Field(ge=0, description="seconds of recording that the frames were taken from")
    slices: Count = Field(description="slices of this length, at different places in the recording")
    pairs: float = Field(ge=0, description="camera-LiDAR pairs in a slice, median")
    solves: Count
    hit_rate: float = Field(ge=0, le=1)
    rotation_deg: Spread
    translation_m: Spread
    sigma_deg: float | None = Field(description="standard deviation of the rotation that the solves claim, median")


Counts6 = tuple[Count, Count, Count, Count, Count, Count]


class HalvesReport(Part):
    """Solves on disjoint halves of the frames, compared: rx ry rz (deg), tx ty tz (m)."""

    splits: Count
    pairs: Count = Field(description="camera-LiDAR pairs in each half")
    solved: Count = Field(description="splits with a result from both halves; only these count below")
    accepted: Count = Field(description="splits with both results accepted")
    hits: Count = Field(description="splits with both results within the hit limits of the source's calibration")
    rms: Maybe6 = Field(description="root mean square difference; null on axes that were not searched")
    largest: Maybe6 = Field(description="largest absolute difference")
    sigma: Maybe6 = Field(description="standard deviation of the difference that the halves claim, median")
    claimed: Counts6 = Field(description="splits in which both halves claim a standard deviation")
    covered: Maybe6 = Field(
        description="share of the `claimed` splits whose difference lies within 3 claimed standard deviations"
    )


class DetectionRow(Part):
    """Checks after one kind of move of the extrinsic, and the share that each classifier flagged. For the right
    extrinsic these shares are the false alarms."""

    name: Text = Field(description="`right`, or how far the extrinsic was moved")
    checks: Count
    flagged: float = Field(
        ge=0, le=1, description="share flagged because the local optimum lies, and its edges insist, elsewhere"
    )
    flagged_low: float = Field(
        ge=0, le=1, description="lower end of its 95 % interval (Wilson), as if no two checks shared a pair"
    )
    flagged_high: float = Field(ge=0, le=1, description="upper end of it")
    undecided: float = Field(ge=0, le=1, description="share that neither accuses nor acquits the extrinsic")
    flagged_by_paper: float = Field(
        ge=0, le=1, description="share flagged by equation (2) with learned limits; for comparison, decides nothing"
    )


class DetectionReport(Part):
    """How well checks detect a wrong extrinsic: limits learned on one half of the pairs, tried on the disjoint other
    half."""

    splits: Count
    pairs: Count = Field(description="camera-LiDAR pairs that were split in two halves")
    moves: tuple[DetectionRow, ...]


class StepRow(Part):
    """Windows within which the mount was moved, and what became of them."""

    name: Text = Field(description="kind of knock; `none`: no move")
    windows: Count
    accepted: float = Field(ge=0, le=1, description="share that was accepted")
    wrong: float = Field(
        ge=0, le=1, description="share that was accepted more than 0.3 deg and 4 σ from where the mount is at the end"
    )
    moved: float = Field(ge=0, le=1, description="share that was refused because the camera moved within the window")
    time_known: float | None = Field(
        description="share whose reported time of the knock is right to 2 s, as a knock may lie anywhere between two "
        "frames; null for knocks without one time"
    )
    off_s: float | None = Field(description="median error of the reported times, s")
    told_s: float | None = Field(description="median length of the reported intervals, s")
    holds: float | None = Field(ge=0, le=1, description="share of the reported intervals that contain the knock")


class NormalisedErrorsReport(Part):
    """Errors of accepted results divided by the standard deviations that they claim: rx ry rz (deg), tx ty tz (m); null
    on axes without a claim."""

    against: Text = Field(description="reference of the errors")
    judged: Count = Field(description="results that were accepted and claim a standard deviation")
    refused: Count = Field(description="the other results, which no figure includes")
    independent: Count = Field(description="judged results that share no frame; the bounds are for this number")
    rms: Maybe6
    largest: Maybe6 = Field(description="largest absolute error")
    sigma: Maybe6 = Field(description="mean claimed standard deviation")
    sigma_over_rms: Maybe6 = Field(description="1 for a true claim; more for one that is too wide")
    within_1_sigma: Maybe6 = Field(description="share of the errors; 0.683 for normal errors")
    within_2_sigma: Maybe6 = Field(description="share of the errors; 0.954 for normal errors")
    within_3_sigma: Maybe6 = Field(description="share of the errors; 0.997 for normal errors")
    bin_edges: tuple[float, ...] = Field(description="bin edges of the histogram, in σ; the outermost bins are open")
    histogram: tuple[tuple[Count, ...], ...] = Field(description="per axis, results by error over σ")
    confidences: tuple[float, ...] = Field(description="shares of the errors that intervals should hold")
    reliability: tuple[tuple[float | None, ...], ...] = Field(description="per axis, shares that they do hold")
    nees: float | None = Field(description="mean squared normalised error per axis; 1 for a true claim")
    nees_low: float | None = Field(description="the `nees` of a true claim is above this in 97.5 % of evaluations")
    nees_high: float | None = Field(description="the `nees` of a true claim is below this in 97.5 % of evaluations")


class ClosureGroup(Part):
    """Closure errors of calibrations on one choice of frames."""

    frames: Text = Field(description="all frames, the same half for both sensors, or different halves")
    pairs_a: Count = Field(description="camera-LiDAR pairs in a solve")
    pairs_b: Count
    errors: NormalisedErrorsReport
    rotation_deg: Spread
    translation_m: Spread = Field(description="null with 3 dof")


class ClosureReport(Message):
    """What `coec evaluate --closure A B --json` prints: two sensors, each calibrated by itself, compared with the known
    pose between them. Errors are about and along the axes of B's camera."""

    source_a: Text
    source_b: Text
    relation: Text = Field(description="what the sources share")
    known: Vector6 = Field(description="pose of sensor A in the frame of B: rx ry rz (deg), tx ty tz (m)")
    from_recordings: bool = Field(
        description="whether `known` comes from the recordings; otherwise from the command line"
    )
    objective: Text
    dof: Literal[3, 6]
    start_rotation_deg: float = Field(description="radius of the sphere of starts")
    start_translation_m: float
    trials: Count
    groups: tuple[ClosureGroup, ...]
    elapsed_s: dict[Text, float] = Field(description="by stage, s")


class FalseAlarmsRow(Part):
    """How often the evidence against a right mount reached the level that is stated for one alarm in `stated_h`."""

    stated_h: float
    driven_h: float = Field(description="hours of driving that the drawn checks cover")
    alarms: Count


class DelayRow(Part):
    """Time from a step of the mount to the check that notices it, s; null if no check notices it in time."""

    step_deg: float
    steps: Count
    suspect_s: Spread
    confirmed_s: Spread


class FromStartRow(Part):
    """An uncommissioned mount that is wrong from the first check on: time until a check asks for an early window, s."""

    off_deg: float
    rigs: Count
    wanted: float = Field(ge=0, le=1, description="share of the rigs whose checks asked for a window within a minute")
    wanted_s: Spread = Field(description="null if not in time")


class AlarmsReport(Message):
    """What `coec alarms --json` prints: the change detector on drawn streams of checks."""

    period_s: float = Field(description="time between checks, s")
    hours_between_false_alarms: float = Field(description="as configured")
    hours_between_false_suspicions: float = Field(description="as configured")
    false: tuple[FalseAlarmsRow, ...]
    delays: tuple[DelayRow, ...]
    creep_deg_per_h: float = Field(description="rate of a mount that turns steadily")
    creep_suspect_h: Spread = Field(description="time until this mount is suspected, h; null if not in time")
    creep_confirmed_h: Spread = Field(description="time until its move is confirmed, h")
    from_start: tuple[FromStartRow, ...]


class EvaluationReport(Message):
    """What `coec evaluate --json` prints: solves from starts all around the source's calibration, on one window."""

    source: Text
    vehicle: Text
    pair: Text
    window_id: Text
    pairs: Count = Field(description="camera-LiDAR pairs in the window")
    camera_model: Text
    objective: Text
    dof: Literal[3, 6]
    start_rotation_deg: float = Field(description="radius of the sphere of starts")
    start_translation_m: float = Field(description="radius of the sphere of starts")
    search_rotation_deg: float = Field(description="half-width of the search box; widened to hold the starts")
    search_translation_m: float = Field(description="likewise; 0 with 3 dof")
    hit_rotation_deg: float = Field(description="a hit ends nearer to the source's calibration than this")
    hit_translation_m: float | None = Field(description="and, with 6 dof, nearer than this; null with 3 dof")
    interrupted: bool = Field(
        default=False, description="ended early: the figures cover the starts and experiments that were finished"
    )
    starts: Count
    hits: Count
    hit_rate: float = Field(ge=0, le=1)
    rotation_deg: Spread = Field(description="error against the source's calibration, all starts")
    translation_m: Spread = Field(description="error against the source's calibration, all starts")
    median: Vector6 = Field(description="median error of all starts: rx ry rz (deg), tx ty tz (m)")
    bias: Maybe6 = Field(description="mean error of the hits: rx ry rz (deg), tx ty tz (m); null without a hit")
    std: Maybe6 = Field(description="standard deviation of the hits about `bias`; null below two hits")
    rms: Maybe6 = Field(description="root mean square error of the hits; null without a hit")
    sigma: Maybe6 = Field(description="median of the standard deviations that the hits claim; null where none")
    from_reference: Vector6 = Field(description="error of a solve that starts at the source's calibration (deg, m)")
    solve_s: Spread = Field(description="time of one solve, without reading the source and inferring depth, s")
    evaluations: Spread = Field(description="evaluations of the objective per solve")
    classified_correctly: float = Field(ge=0, le=1, description="share of starts whose verdict agrees with hit or miss")
    verdicts: VerdictCounts
    stop_reasons: Counts = Field(description="starts by the reason for which their search ended")
    worst_start: Count = Field(description="index of the start that ended furthest from a hit")
    frames: tuple[FramesPoint, ...] = Field(description="error against the number of frames; empty if not asked for")
    slices: tuple[SlicePoint, ...] = Field(description="error against the length of the slice; empty if not asked for")
    halves: HalvesReport | None = Field(description="agreement of disjoint halves; null if not asked for")
    detection: DetectionReport | None = Field(
        default=None, description="how well checks detect a wrong extrinsic; null if not asked for"
    )
    steps: tuple[StepRow, ...] = Field(default=(), description="windows with a knock in them; empty if not asked for")
    normalised: tuple[NormalisedErrorsReport, ...] = Field(
        default=(), description="errors over claimed standard deviations; empty if not asked for"
    )
    depth_identity: Text = Field(description="sha256 of the depth network, or `precomputed`")
    config_hash: Text = Field(description="hash of everything that decides the results, except the start")
    elapsed_s: dict[Text, float] = Field(description="by stage, s")


class ComparisonReport(Message):
    """What `coec evaluate --objective all --json` prints: every method on the same window and from the same starts."""

    source: Text
    methods: dict[Text, EvaluationReport] = Field(description="by the name of the objective")
    not_evaluated: dict[Text, Text] = Field(description="objectives that this source does not allow, and why")
    interrupted: bool = Field(default=False, description="ended early: the last method is not finished")
    elapsed_s: dict[Text, float] = Field(description="by stage, s")


Maybe3 = tuple[float | None, float | None, float | None]

Suitability = Literal["good", "usable_in_fused", "do_not_use"]


class DepthFrame(Part):
    """A depth map, compared with the sweep of its frame."""

    stamp_ns: int
    points: Count = Field(description="LiDAR points in view that fall on a value of the map")
    covered: float = Field(ge=0, le=1, description="share of the points in view that do")
    rank_correlation: float | None = Field(
        description="Spearman's rank correlation of the map with inverse range; null below 2 points"
    )
    inference_ms: float | None = Field(description="null if the map came with the frame")


class ModelAssessment(Message):
    """What `coec models assess --json` prints: how well a depth network suits calibration, on one window at the
    source's calibration. Rank correlations are positive for networks that give inverse depth, negative for depth."""

    model: Text
    source: Text
    window_id: Text
    pairs: Count = Field(description="camera-LiDAR pairs in the window")
    depth_identity: Text = Field(description="sha256 of the depth network, or `precomputed`")
    suitability: Suitability
    verdict: Text = Field(description="one sentence for people")
    rank_correlation: float | None = Field(description="median over the frames")
    covered: float = Field(ge=0, le=1, description="median over the frames")
    inference_ms: float | None = Field(description="median over the frames")
    mi: float = Field(description="mutual information at the source's calibration, nats")
    mi_of_unrelated: float = Field(description="mutual information with the maps of other frames, nats")
    mi_over_unrelated: float
    bias_deg: Vector3 = Field(description="optimum of the mutual information, from the source's calibration, rx ry rz")
    half_width_deg: Maybe3 = Field(
        description="half-width of the peak, half-way down to `mi_of_unrelated`, rx ry rz; null: no peak"
    )
    peakedness_per_deg2: Vector3 = Field(description="-f''/f at the optimum, rx ry rz")
    search_deg: float = Field(description="half-width of the box in which the optimum was searched")
    frames: tuple[DepthFrame, ...]
    elapsed_s: dict[Text, float] = Field(description="by stage, s")
