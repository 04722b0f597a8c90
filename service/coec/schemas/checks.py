"""Documents of `coec sim checks --json`: what checks of simulated drives say, and what the change detector makes of
them. Radians and metres, as the detector takes them; axes rx ry rz tx ty tz about and along the camera axes."""

from __future__ import annotations

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.replies import Count, Vector6


class Judged(Part):
    """One check, judged: see `Observation`, of which it holds what the detector takes."""

    offset: Vector6
    sigma: Vector6
    noise: Vector6
    place: Vector6
    dispersion: float
    distance2: float
    flagged: bool
    undecided: bool
    faint: tuple[str, ...] = Field(description="of what its edges have too little; empty where they are not faint")
    causes: tuple[str, ...] = Field(description="what is wrong with its data, by code")


class CheckedPose(Part):
    """All checks of a drive at one served pose, one after the other, as two rigs see them: one of which nothing is
    known, and one that was commissioned on other drives."""

    moved: str = Field(description="`right`, or how far the served pose is off")
    uncommissioned: tuple[Judged, ...]
    commissioned: tuple[Judged, ...] = Field(description="empty where the rig could not be commissioned")


class CheckedDrive(Message):
    """One drive."""

    name: str
    rig: str
    place: str
    seed: Count
    source: str = Field(description="SOURCE that draws it again")
    poses: tuple[CheckedPose, ...]
    failure: str | None = Field(default=None, description="why the drive has no result")


class MovedStatistics(Part):
    """Of all checks at poses that are off by one amount."""

    moved: str
    drives: Count
    checks: Count
    blind: Count = Field(description="with a cause in their data: they say nothing of the pose")
    weak: Count = Field(description="with faint edges")
    undecided: Count = Field(description="with clear edges that neither accuse the pose nor acquit it")
    clear: Count = Field(description="all others")
    flagged: Count = Field(description="of the clear ones")
    flagged_low: float | None = Field(description="95 % interval of that share (Wilson); null of no clear check")
    flagged_high: float | None
    suspected: Count = Field(description="drives on which the detector suspected the mount")
    confirmed: Count = Field(description="drives on which it became certain")
    delay_checks: tuple[Count, ...] = Field(description="until it did, of each of those")


class PlaceStatistics(Part):
    """Of all checks of right mounts in places of one kind: how many can tell."""

    place: str
    checks: Count
    blind: Count
    weak: Count
    undecided: Count
    flagged: Count


class HoursStatistics(Part):
    """What the detector made of a right mount in hours of driving."""

    how: str = Field(description="`rendered`, one after the other; or `resampled` from these, place after place")
    hours: float
    suspicions: Count
    alarms: Count
    alarms_per_100_h_at_most: float = Field(
        description="of 95 % confidence that alarms come no more often (Poisson); of resampled hours, as if the "
        "rendered drives were all that there are"
    )
    alarmed: tuple[str, ...] = Field(description="where: rig and place")


class TailStatistics(Part):
    """How often a right mount would be accused, from how far off places are, beyond those that were met."""

    stay_checks: Count = Field(description="a vehicle is at another place after so many")
    places: Count = Field(description="drives with a clear check of a right mount")
    farthest: float = Field(description="displacement of the farthest of them, standard deviations of what places are")
    accused_at: float | None = Field(
        description="displacement at which half of drawn places accuse; null where the farthest drawn do not"
    )
    alarms_per_100_h: float = Field(description="mean over all tails that fit")
    alarms_per_100_h_at_most: float = Field(description="of 95 % of the tails that fit, by how well they do")


class RigStatistics(Part):
    """Of a rig that was commissioned, or was not."""

    commissioned: bool
    moved: tuple[MovedStatistics, ...]
    places: tuple[PlaceStatistics, ...]
    hours: tuple[HoursStatistics, ...]
    tails: tuple[TailStatistics, ...] = Field(description="empty with fewer than twenty places")


class ChecksReport(Message):
    """What `coec sim checks --json` prints and report.json holds."""

    drives: Count
    failed: dict[str, str] = Field(description="drives without a result, and why")
    rigs: tuple[RigStatistics, ...]
