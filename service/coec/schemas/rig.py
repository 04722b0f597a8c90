"""Documents of `coec sim rig-moves --json`: how well the sensors of a rig that moved are told, and how much better the
rig knows its pairs than they do by themselves."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.replies import Count, Vector6


class MovesRow(Part):
    """Drives with one kind of fault on one rig."""

    rig: str
    fault: str
    drives: Count
    right: Count = Field(description="drives on which exactly those that moved were named within the time allowed")
    undecided: Count = Field(description="on which not all of these were, and no other")
    wrong: Count = Field(description="on which ever one was named that had not moved")
    delay_s: tuple[float, ...] = Field(description="from the fault until all were named, of those that were, in order")


class JointRow(Part):
    """Windows of all pairs of a rig at one time, combined."""

    rig: str
    rigs: Count = Field(description="drawn")
    pairs: Count = Field(description="of one rig")
    rms_ratio: Vector6 = Field(description="rms error of the rig estimate over that of the windows, per axis")
    rms_ratio_all: float = Field(description="root of the mean of their squares")
    nees: float = Field(description="mean squared error of the rig estimate over what it claims, per axis: 1 is honest")
    consistent: Count = Field(description="rigs whose pairs were said to fit each other")
    biased_found: Count = Field(description="rigs, with one window 1° off, of which that window alone was left out")
    biased_missed: Count = Field(description="of which the pairs were said to fit each other all the same")


class KnockedRow(Part):
    """One window of each pair of a rig after a LiDAR of it was knocked, combined with what was known before."""

    rig: str
    rigs: Count = Field(description="drawn")
    pairs: Count = Field(description="of one rig")
    rms_ratio: Vector6 = Field(description="rms error of the rig estimate over that of the windows, per axis")
    rms_ratio_all: float = Field(description="root of the mean of their squares")
    rms_ratio_without: float = Field(description="the same of an estimate by these windows alone")
    nees: float = Field(description="mean squared error of the rig estimate over what it claims, per axis: 1 is honest")
    worst_deg: float = Field(description="error of the worst pair of all rigs")
    worst_of_pairs_deg: float = Field(description="the same of the windows")
    consistent: Count = Field(description="rigs whose windows were said to fit what was known before")
    also_missed: Count = Field(description="of rigs of which a camera was turned by 0.5° as well, those said to fit")


class RigMovesReport(Message):
    """What `coec sim rig-moves --json` prints."""

    allowed_s: float
    moves: tuple[MovesRow, ...]
    joint: tuple[JointRow, ...]
    knocked: tuple[KnockedRow, ...]


class Mounts(StrEnum):
    """Which sensor of a pair is not where it was built."""

    AS_BUILT = "as_built"
    CAMERA = "camera"
    LIDAR = "lidar"


class RigLook(Part):
    """One look at one pair of a rendered rig: see `Observation`, of which it holds what attribution and the change
    detector take. Radians and metres; axes rx ry rz tx ty tz about and along the camera axes."""

    edge: str
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
    causes: tuple[str, ...]


class RigDriveRow(Message):
    """All looks of one rendered drive of a rig, in the order of their stamps."""

    name: str
    seed: Count
    camera: str = Field(description="of every camera of the rig, as `fisheye350`")
    looks: tuple[RigLook, ...]
    failure: str | None = Field(default=None, description="why the drive has no result")


class RigDriveMoves(Part):
    """What was said of one fault on one rendered drive; seconds of driving after the fault, null where it was not."""

    name: str
    moved: tuple[str, ...] = Field(description="sensors that were knocked")
    named_s: float | None = Field(description="when exactly these were named")
    alarm_s: float | None = Field(description="when the first pair that has one of them was sure that its mount moved")
    wrong: tuple[str, ...] = Field(description="sensors that were ever named and had not been knocked")
    wrong_s: float | None = Field(description="when the first of these was, of a drive that begins at the fault")


class RigDrivesRow(MovesRow):
    """Of all rendered drives with one fault."""

    alarms_s: tuple[float, ...] = Field(description="of those with an alarm, see `alarm_s`, in order")
    each: tuple[RigDriveMoves, ...]


class RigDrivesReport(Message):
    """What `coec sim rig-drives --json` prints."""

    allowed_s: float
    camera: str
    drives: Count = Field(description="that were drawn and have a result")
    failed: Count = Field(description="that have none")
    looks: Count
    faint: Count = Field(description="looks with faint edges")
    blind: Count = Field(description="looks with a cause in their data")
    moves: tuple[RigDrivesRow, ...]
