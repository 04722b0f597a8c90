"""Documents of `coec sim matrix --json`: how the estimator and the monitor perform on many simulated drives.

Angles in degrees, lengths in metres, axes rx ry rz tx ty tz about and along the camera axes. Errors are taken against
the truth at the last pair. A number that could not be computed is null.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from coec.schemas.base import Message, Part, Text
from coec.schemas.replies import Count, Counts, Maybe6


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
