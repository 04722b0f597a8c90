"""Documents of `coec sim matrix`, `coec sim checks`, `coec sim rig-moves` and `coec sim rig-drives` with `--json`.
Angles in degrees, lengths in metres, unless a description says otherwise; axes rx ry rz tx ty tz about and along
the camera axes. A number that could not be computed is null.

Angles in degrees, lengths in metres, axes rx ry rz tx ty tz about and along the camera axes. Errors are taken against
the truth at the last pair. A number that could not be computed is null.
"""

from enum import StrEnum
from typing import Literal

from pydantic import Field

from coec.schemas.message import Message, Part, Text
from coec.schemas.replies import Count, Counts, Maybe6, Maybe6x6, Vector6


class SolvedWindow(Part):
    """One window, solved from a start away from the truth."""

    pairs: Count
    start_deg: float = Field(description="angle between the start of the search and the truth")
    start_m: float = Field(description="distance between the start and the truth; with 3 dof it stays as it is")
    accepted: bool
    hit: bool = Field(description="within the limits of a hit; with 6 dof the translation counts, too")
    rotation_deg: float | None = Field(description="angle of the rotation error; null without an estimate")
    translation_m: float | None
    error: Maybe6 = Field(description="null on axes that were not solved")
    sigma: Maybe6 = Field(description="as the estimate claims it")
    reasons: tuple[Text, ...] = Field(description="codes of the reasons why it was refused")
    evaluations: Count
    failure: Text | None = Field(description="why there is no estimate")


class Watched(Part):
    """The checks of one served pose along a drive, in order, through the change detector."""

    moved: Text = Field(description="`right`, or how far the served pose is off")
    checks: Count
    flagged: Count = Field(description="checks over their limits")
    blind: Count = Field(description="checks with something wrong in the data: they say nothing about the pose")
    alarms: Count = Field(description="how often the detector became certain of a wrong mount")
    seconds: float = Field(ge=0, description="seconds of driving that the checks cover")
    delay_checks: Count | None = Field(description="checks until the first alarm; null without one")


class MatrixRow(Message):
    """One drive."""

    name: Text
    scene: Text
    lens: Text
    lidar: Text
    light: Text
    fault: Text
    seed: Count
    source: Text = Field(description="SOURCE that draws it again")
    windows: dict[Literal["3", "6"], tuple[SolvedWindow, ...]] = Field(description="by degrees of freedom")
    watched: tuple[Watched, ...] = Field(description="empty if the mount itself moves")
    failure: Text | None = Field(default=None, description="why the drive has no result")
    settings: Text = Field(description="what else decides the result; a row with other settings is run again")
    cpu_s: float = Field(ge=0, description="processor time of one core, drawing included, s")


class AxisStatistics(Part):
    """Errors on one axis, over the accepted windows that solved it."""

    axis: Literal["rx", "ry", "rz", "tx", "ty", "tz"]
    windows: Count
    bias: float | None = Field(description="mean error")
    rms: float | None
    mean_sigma: float | None
    sigma_over_rms: float | None = Field(description="mean sigma over rms error: 1 is right, more is too cautious")
    rms_normalised: float | None = Field(description="rms of error over sigma: 1 is right, more claims too much")
    within_1: float | None = Field(description="share of errors within 1 sigma; 0.683 for normal errors")
    within_2: float | None = Field(description="share within 2 sigma; 0.954 for normal errors")
    within_3: float | None = Field(description="share within 3 sigma; 0.997 for normal errors")


class GroupStatistics(Part):
    """Windows of the drives that have one property in common."""

    of: Text = Field(description="the property: scene, lens, lidar, light or fault")
    value: Text
    windows: Count
    hits: Count
    accepted: Count
    accepted_wrong: Count
    median_deg: float | None = Field(description="rotation error of all windows with an estimate")


class SolveStatistics(Part):
    """All windows solved with one number of degrees of freedom."""

    dof: Literal[3, 6]
    windows: Count
    hits: Count
    accepted: Count
    accepted_hits: Count
    accepted_wrong: Count = Field(description="off by more than the limit and by more than 4 sigma on some axis")
    wrong: tuple[Text, ...] = Field(description="names of the accepted wrong ones, with axis, error and sigma")
    axes: tuple[AxisStatistics, ...]
    groups: tuple[GroupStatistics, ...]
    reasons: Counts = Field(description="refused windows by code; a window may have several")


class WatchStatistics(Part):
    """All checks of one served pose."""

    moved: Text
    drives: Count
    checks: Count
    flagged: float | None = Field(description="flagged share of the checks that could tell")
    blind: Count
    alarms: Count
    alarmed: Count = Field(description="drives with an alarm")
    hours: float
    alarms_per_hour: float | None
    median_delay_checks: float | None = Field(description="over the drives with an alarm")
    names: tuple[Text, ...] = Field(
        description="the drives that went wrong: with an alarm at the right pose, without one at any other"
    )


class MatrixReport(Message):
    """What `coec sim matrix --json` prints and report.json holds."""

    drives: Count
    failed: dict[Text, Text] = Field(description="drives without a result, and why")
    solves: tuple[SolveStatistics, ...]
    watched: tuple[WatchStatistics, ...]
    rows: tuple[MatrixRow, ...]


class Judged(Part):
    """One judged check: those fields of `Observation` that the change detector takes."""

    offset: Vector6
    sigma: Vector6
    noise: Vector6
    place: Vector6
    dispersion: float
    distance2: float
    flagged: bool
    undecided: bool
    faint: tuple[Text, ...] = Field(description="what its edges have too little of; empty if they are not faint")
    causes: tuple[Text, ...] = Field(description="codes of what is wrong with its data")


class CheckedPose(Part):
    """All checks of a drive at one served pose, in order, for two rigs: one that is not commissioned, and one that was
    commissioned on other drives."""

    moved: Text = Field(description="`right`, or how far the served pose is off")
    uncommissioned: tuple[Judged, ...]
    commissioned: tuple[Judged, ...] = Field(description="empty if the rig could not be commissioned")


class CheckedDrive(Message):
    """One drive."""

    name: Text
    rig: Text
    place: Text
    seed: Count
    source: Text = Field(description="SOURCE that draws it again")
    poses: tuple[CheckedPose, ...]
    failure: Text | None = Field(default=None, description="why the drive has no result")


class MovedStatistics(Part):
    """All checks at poses that are off by one amount."""

    moved: Text
    drives: Count
    checks: Count
    blind: Count = Field(description="checks with something wrong in their data: they say nothing about the pose")
    weak: Count = Field(description="checks with faint edges")
    undecided: Count = Field(description="checks with clear edges that neither accuse nor acquit the pose")
    clear: Count = Field(description="all other checks")
    flagged: Count = Field(description="clear checks that are flagged")
    flagged_low: float | None = Field(
        description="lower end of the 95 % interval (Wilson) of the flagged share of clear checks, `flagged_high` the "
        "upper end; null without clear checks"
    )
    flagged_high: float | None
    suspected: Count = Field(description="drives on which the detector suspected the mount")
    confirmed: Count = Field(description="drives on which the detector became certain")
    delay_checks: tuple[Count, ...] = Field(description="checks until it became certain, for each of those drives")


class PlaceStatistics(Part):
    """All checks of right mounts in places of one kind, and how many of them can tell."""

    place: Text
    checks: Count
    blind: Count
    weak: Count
    undecided: Count
    flagged: Count


class HoursStatistics(Part):
    """How often the detector accused a right mount in hours of driving."""

    how: Text = Field(
        description="`rendered`: the drives one after the other; `resampled`: drawn from them, place after place"
    )
    hours: float
    suspicions: Count
    alarms: Count
    alarms_per_100_h_at_most: float = Field(
        description="upper bound of the alarm rate at 95 % confidence (Poisson); for resampled hours it holds as if "
        "there were no drives but the rendered ones"
    )
    alarmed: tuple[Text, ...] = Field(description="where there were alarms: rig and place")


class TailStatistics(Part):
    """How often a right mount would be accused: extrapolated to places that displace checks further than any that was
    met."""

    stay_checks: Count = Field(description="checks after which the vehicle is at another place")
    places: Count = Field(description="drives with a clear check of a right mount")
    farthest: float = Field(
        description="displacement of the farthest of these places, in standard deviations of `place`"
    )
    accused_at: float | None = Field(
        description="displacement at which half of the drawn places accuse; null if the farthest drawn do not"
    )
    alarms_per_100_h: float = Field(description="mean over all tails that fit")
    alarms_per_100_h_at_most: float = Field(
        description="bound that 95 % of the tails that fit, weighted by how well they fit, stay below"
    )


class RigStatistics(Part):
    """Figures of a rig that was commissioned, or was not."""

    commissioned: bool
    moved: tuple[MovedStatistics, ...]
    places: tuple[PlaceStatistics, ...]
    hours: tuple[HoursStatistics, ...]
    tails: tuple[TailStatistics, ...] = Field(description="empty with fewer than twenty places")


class ChecksReport(Message):
    """What `coec sim checks --json` prints and report.json holds."""

    drives: Count
    failed: dict[Text, Text] = Field(description="drives without a result, and why")
    rigs: tuple[RigStatistics, ...]


class MovesRow(Part):
    """Drives with one kind of fault on one rig."""

    rig: Text
    fault: Text
    drives: Count
    right: Count = Field(description="drives on which exactly the moved sensors were named within the time allowed")
    undecided: Count = Field(description="drives on which not all of them were named, and no other sensor was")
    wrong: Count = Field(description="drives on which a sensor that had not moved was ever named")
    delay_s: tuple[float, ...] = Field(
        description="times from the fault until all were named, of the right drives, ascending"
    )


class JointRow(Part):
    """One window of each pair of a rig, all from one time, combined."""

    rig: Text
    rigs: Count = Field(description="rigs that were drawn")
    pairs: Count = Field(description="pairs of one rig")
    rms_ratio: Vector6 = Field(description="rms error of the rig estimate over that of the windows, per axis")
    rms_ratio_all: float = Field(description="root mean square of `rms_ratio`")
    nees: float = Field(
        description="mean squared error of the rig estimate over its claimed variance, per axis: 1 is honest"
    )
    consistent: Count = Field(description="rigs whose pairs were reported to fit each other")
    biased_found: Count = Field(description="rigs with one window 1° off, where only that window was left out")
    biased_missed: Count = Field(description="rigs with one window 1° off, where the pairs were reported to fit")


class KnockedRow(Part):
    """One window of each pair of a rig after one of its LiDARs was knocked, combined with what was known before."""

    rig: Text
    rigs: Count = Field(description="rigs that were drawn")
    pairs: Count = Field(description="pairs of one rig")
    rms_ratio: Vector6 = Field(description="rms error of the rig estimate over that of the windows, per axis")
    rms_ratio_all: float = Field(description="root mean square of `rms_ratio`")
    rms_ratio_without: float = Field(description="`rms_ratio_all` of an estimate from these windows alone")
    nees: float = Field(
        description="mean squared error of the rig estimate over its claimed variance, per axis: 1 is honest"
    )
    worst_deg: float = Field(description="error of the worst pair of all rigs, by the rig estimate")
    worst_of_pairs_deg: float = Field(description="error of the worst pair of all rigs, by the windows")
    consistent: Count = Field(description="rigs whose windows were reported to fit what was known before")
    also_missed: Count = Field(description="rigs reported to fit although a camera was turned by 0.5° as well")


class RigMovesReport(Message):
    """What `coec sim rig-moves --json` prints."""

    allowed_s: float
    moves: tuple[MovesRow, ...]
    joint: tuple[JointRow, ...]
    knocked: tuple[KnockedRow, ...]


class Mounts(StrEnum):
    """Which sensor of a pair was moved from where it was built in."""

    AS_BUILT = "as_built"
    CAMERA = "camera"
    LIDAR = "lidar"


class RigLook(Part):
    """One look at one pair of a rendered rig: those fields of `Observation` that attribution and the change detector
    take. Radians and metres; axes rx ry rz tx ty tz about and along the camera axes."""

    edge: Text
    mounts: Mounts
    pair_stamps_ns: tuple[int, ...] = Field(min_length=1)
    offset: Vector6
    sigma: Vector6
    noise: Vector6
    place: Vector6
    dispersion: float
    distance2: float
    flagged: bool
    weak: bool
    causes: tuple[Text, ...]


class RigWindow(Part):
    """One urgent window of one pair of a rendered rig: what `calibration.tracker.Measurement` takes. Radians and
    metres."""

    edge: Text
    mounts: Mounts
    first_ns: int = Field(description="stamp of its first pair of frames")
    last_ns: int = Field(description="stamp of its last pair of frames")
    known_ns: int = Field(description="when its answer counts")
    accepted: bool
    reasons: tuple[Text, ...] = Field(description="codes of the reasons for which it was refused")
    offset: Vector6 = Field(description="from the extrinsic that the pair serves")
    noise: Maybe6x6
    systematic: dict[Text, Vector6]


class RigDriveRow(Message):
    """All looks at one rendered drive of a rig, in the order of their stamps, and its urgent windows."""

    name: Text
    seed: Count
    camera: Text = Field(description="lens of every camera of the rig, such as `fisheye350`")
    looks: tuple[RigLook, ...] = ()
    windows: tuple[RigWindow, ...] = ()
    failure: Text | None = Field(default=None, description="why the drive has no result")


class RigDriveMoves(Part):
    """What was reported of one fault on one rendered drive. Times are seconds of driving after the fault; null if the
    event did not happen."""

    name: Text
    moved: tuple[Text, ...] = Field(description="sensors that were knocked")
    named_s: float | None = Field(description="when exactly these sensors were named")
    alarm_s: float | None = Field(description="when the first pair with one of them was sure that its mount had moved")
    wrong: tuple[Text, ...] = Field(description="sensors that were ever named but had not been knocked")
    wrong_s: float | None = Field(description="when the first of these was named, of a drive that begins at the fault")


class RigDrivesRow(MovesRow):
    """All rendered drives with one fault."""

    alarms_s: tuple[float, ...] = Field(description="`alarm_s` of the drives with an alarm, ascending")
    each: tuple[RigDriveMoves, ...]


class RigDrivesReport(Message):
    """What `coec sim rig-drives --json` prints."""

    allowed_s: float
    camera: Text
    drives: Count = Field(description="drives with a result")
    failed: Count = Field(description="drives without a result")
    looks: Count
    faint: Count = Field(description="looks with faint edges")
    blind: Count = Field(description="looks with something wrong in their data")
    windows: Count = Field(description="urgent windows whose answers came before the end of their drive")
    accepted: Count = Field(description="how many of these were accepted")
    moves: tuple[RigDrivesRow, ...]
