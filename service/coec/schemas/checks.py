"""Documents of `coec sim checks --json`: the checks of simulated drives, and how the change detector judges them.
Radians and metres, as the detector takes them; axes rx ry rz tx ty tz about and along the camera axes."""

from __future__ import annotations

from pydantic import Field

from coec.schemas.base import Message, Part, Text
from coec.schemas.replies import Count, Vector6


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
