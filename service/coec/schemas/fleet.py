"""What is said of many windows that were judged again: a row each, and a summary of a batch.

Angles in degrees, lengths in metres, axes rx ry rz tx ty tz about and along the camera axes.
"""

from __future__ import annotations

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.replies import CalibrationResult, Count, Counts, Maybe6

AXES = ("rx_deg", "ry_deg", "rz_deg", "tx_m", "ty_m", "tz_m")
"""Columns of a correction, in its order; `sigma_` before them is its standard deviation."""

SEEN = (0.5, 0.5, 0.5, 0.1, 0.1, 0.1)
"""Steps, deg and m, that a monitor has to see: the measure of a drift."""


class WindowRow(Message):
    """A window of a batch, as it is kept until it becomes a row of a table. It holds a result or an error."""

    url: str = Field(description="where the window was found; its name in the batch")
    sha256: str | None = Field(description="of the whole file, hexadecimal; null where it could not be read")
    bytes: Count | None = Field(description="of the file")
    vehicle: str = Field(description="as the window says; empty where it does not")
    result: CalibrationResult | None = Field(default=None, description="what was decided; null with an error")
    recorded: str | None = Field(default=None, description="sha256 of the result in the file, as canonical JSON")
    decided: str | None = Field(default=None, description="likewise of `result`: equal where the decision is the same")
    error_code: str | None = Field(default=None, description="why there is no result, for programs")
    error: str | None = Field(default=None, description="likewise, for people")
    seconds: float = Field(ge=0, description="that reading and solving took, by the clock on the wall")
    cpu_s: float = Field(ge=0, description="processor time of the same")
    versions: dict[str, str] = Field(description="of the program and of what it calculates with")


class BatchReport(Message):
    """What `coec batch --json` prints."""

    output: str = Field(description="folder of the tables")
    windows: Count = Field(description="that there are")
    kept: Count = Field(description="of them, judged before this run")
    accepted: Count
    refused: Count
    errors: Counts = Field(description="windows without a result, by code")
    compared: Count = Field(description="windows whose vehicle had decided, too, and that hold its result")
    differing: Count = Field(description="of them, those with another decision now, to the byte")
    elapsed_s: float = Field(ge=0, description="of this run")
    cpu_s: float = Field(ge=0, description="of this run's windows, in all processes")
    share_of_ideal: float | None = Field(
        description="time that this run's windows took, over cores and elapsed time: 1 where no core ever waited"
    )


class DayOfPair(Part):
    """Accepted windows of a pair on one day; null on axes that none of them told."""

    date: str = Field(description="UTC, as 2026-11-22")
    windows: Count
    low: Maybe6 = Field(description="16th percentile of the correction: one standard deviation below, were it normal")
    middle: Maybe6 = Field(description="median")
    high: Maybe6 = Field(description="84th percentile")


class PairOfFleet(Part):
    """A pair of a vehicle over time. Corrections are from its nominal calibration."""

    vehicle: str
    pair: str
    windows: Count
    accepted: Count
    errors: Count = Field(description="windows without a result")
    last_ns: int | None = Field(description="stamp of the last window with a result, ns")
    latest: Maybe6 = Field(description="median of the last accepted windows; null on axes that they do not tell")
    drift: Maybe6 = Field(description="`latest` less the median of as many that were accepted first")
    slope: Maybe6 = Field(description="of the corrections over time, per 30 days; null with windows of one day")
    worst: str | None = Field(description="axis that drifted furthest, measured by what a monitor has to see")
    urgency: float = Field(ge=0, description="drift of that axis, in multiples of that")
    days: tuple[DayOfPair, ...]


class FigureOfFleet(Part):
    """A figure of self-diagnosis over the accepted windows of all vehicles."""

    name: str
    pair: str
    vehicles: Count
    windows: Count
    low: float = Field(description="0.5 % of the windows are below")
    middle: float
    high: float = Field(description="0.5 % of the windows are above")


class ChangedWindow(Part):
    """A window that is decided otherwise than before."""

    vehicle: str
    window_id: str
    before: str = Field(description="`accepted`, or codes of the reasons or the error")
    now: str
    rotation_deg: float | None = Field(description="largest difference of the corrections; null without two results")
    translation_m: float | None


class FleetChanges(Part):
    """Windows of two batches, matched by their hashes."""

    both: Count
    identical: Count = Field(description="to the byte")
    newly_accepted: Count
    newly_refused: Count
    newly_failing: Count = Field(description="without a result now, with one before")
    rotation_deg: float | None = Field(description="root mean square over windows accepted twice")
    translation_m: float | None
    windows: tuple[ChangedWindow, ...] = Field(description="decided otherwise, those furthest apart first")


class FalseAlarms(Part):
    """What became of the alarms of a fleet's pairs, by their last words."""

    pairs: Count = Field(description="that have told")
    watched_h: float = Field(ge=0, description="sensor time between completed checks, of all pairs, h")
    confirmed: Count = Field(description="alarms that ended with another extrinsic")
    withdrawn: Count = Field(description="alarms that ended with the extrinsic that they accused: false ones")
    per_100_h: float | None = Field(description="of false ones, in 100 h of a pair; null where nobody watched")
    per_100_h_at_most: float | None = Field(description="upper end of that: exceeded once in twenty (Poisson)")
    by_pair: dict[str, Count] = Field(description="false ones by vehicle/pair, of the pairs that have any")


class FleetReport(Message):
    """What `coec fleet report --json` prints."""

    vehicles: Count
    pairs: tuple[PairOfFleet, ...] = Field(description="the most urgent first")
    windows: Count
    accepted: Count
    refusals: Counts = Field(description="windows by code of a reason; one window may have several")
    errors: Counts = Field(description="windows without a result, by code")
    first_ns: int | None
    last_ns: int | None
    figures: tuple[FigureOfFleet, ...]
    changes: FleetChanges | None = Field(default=None, description="with --against")
    false_alarms: FalseAlarms | None = Field(default=None, description="with --now")
