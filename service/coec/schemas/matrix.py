"""Documents of `coec sim matrix --json`: what the estimator and the monitor make of many simulated drives.

Angles in degrees, lengths in metres, axes rx ry rz tx ty tz about and along the camera axes. Errors are taken against
the truth at the last pair. A number that could not be computed is null.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.replies import Count, Counts, Maybe6


class SolvedWindow(Part):
    """One window, solved from a start that is off."""

    pairs: Count
    start_deg: float = Field(description="angle from the truth at which the search began")
    start_m: float = Field(description="and distance; with 3 dof that of the centre that is held")
    accepted: bool
    hit: bool = Field(description="within the limits of a hit; with 6 dof the translation counts, too")
    rotation_deg: float | None = Field(description="angle of the rotation error; null without an estimate")
    translation_m: float | None
    error: Maybe6 = Field(description="null on axes that were not solved")
    sigma: Maybe6 = Field(description="as the estimate claims it")
    reasons: tuple[str, ...] = Field(description="codes for which it was refused")
    evaluations: Count
    failure: str | None = Field(description="why there is no estimate")


class Watched(Part):
    """Checks of one served pose along a drive, one after the other, through the change detector."""

    moved: str = Field(description="`right`, or how far the served pose is off")
    checks: Count
    flagged: Count = Field(description="checks over their limits")
    blind: Count = Field(description="checks with a cause in the data: they say nothing of the pose")
    alarms: Count = Field(description="times that the detector became certain of a wrong mount")
    seconds: float = Field(ge=0, description="of driving that the checks cover")
    delay_checks: Count | None = Field(description="checks until the first alarm; null without one")


class MatrixRow(Message):
    """One drive."""

    name: str
    scene: str
    lens: str
    lidar: str
    light: str
    fault: str
    seed: Count
    source: str = Field(description="SOURCE that draws it again")
    windows: dict[Literal["3", "6"], tuple[SolvedWindow, ...]] = Field(description="by degrees of freedom")
    watched: tuple[Watched, ...] = Field(description="empty where the mount itself moves")
    failure: str | None = Field(default=None, description="why the drive has no result")
    settings: str = Field(description="what decides the result beside the drive; another one is run again")
    cpu_s: float = Field(ge=0, description="of one core, drawing included")


class AxisStatistics(Part):
    """Of one axis, over the accepted windows that solved it."""

    axis: Literal["rx", "ry", "rz", "tx", "ty", "tz"]
    windows: Count
    bias: float | None = Field(description="mean error")
    rms: float | None
    mean_sigma: float | None
    sigma_over_rms: float | None = Field(description="mean sigma over rms error: 1 is right, more hides")
    rms_normalised: float | None = Field(description="of error over sigma: 1 is right, more claims too much")
    within_1: float | None = Field(description="share of errors within 1 sigma; 0.683 of a normal distribution")
    within_2: float | None = Field(description="0.954")
    within_3: float | None = Field(description="0.997")


class GroupStatistics(Part):
    """Of the drives that have one property in common."""

    of: str = Field(description="scene, lens, lidar, light or fault")
    value: str
    windows: Count
    hits: Count
    accepted: Count
    accepted_wrong: Count
    median_deg: float | None = Field(description="rotation error of all windows with an estimate")


class SolveStatistics(Part):
    """Of all windows of one number of degrees of freedom."""

    dof: Literal[3, 6]
    windows: Count
    hits: Count
    accepted: Count
    accepted_hits: Count
    accepted_wrong: Count = Field(description="off by more than the limit and by more than 4 sigma on some axis")
    wrong: tuple[str, ...] = Field(description="the names of these, with axis, error and sigma")
    axes: tuple[AxisStatistics, ...]
    groups: tuple[GroupStatistics, ...]
    reasons: Counts = Field(description="refused windows by code; a window may have several")


class WatchStatistics(Part):
    """Of all checks of one served pose."""

    moved: str
    drives: Count
    checks: Count
    flagged: float | None = Field(description="share of the checks that could tell")
    blind: Count
    alarms: Count
    alarmed: Count = Field(description="drives with an alarm")
    hours: float
    alarms_per_hour: float | None
    median_delay_checks: float | None = Field(description="of the drives with an alarm")
    names: tuple[str, ...] = Field(description="drives with an alarm at the right pose, drives without one elsewhere")


class MatrixReport(Message):
    """What `coec sim matrix --json` prints and report.json holds."""

    drives: Count
    failed: dict[str, str] = Field(description="drives without a result, and why")
    solves: tuple[SolveStatistics, ...]
    watched: tuple[WatchStatistics, ...]
    rows: tuple[MatrixRow, ...]
