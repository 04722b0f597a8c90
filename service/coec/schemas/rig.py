"""Documents of `coec sim rig-moves --json` and `coec sim rig-drives --json`: how well the sensor of a rig that moved is
named, and how much better the rig estimate knows the pairs than each pair's own window."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from coec.schemas.base import Message, Part, Text
from coec.schemas.replies import Count, Maybe6x6, Vector6


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
