"""Documents that only commands print or write: the findings of `coec doctor`, the report of `coec fetch` on an
incident, and those about many vehicles: a row for each window that was evaluated again, the summary of a batch, the
report on a fleet, and the state of a fleet at this moment (`coec watch --once --json`).

Angles in degrees, lengths in metres, axes rx ry rz tx ty tz about and along the camera axes.
"""

from typing import Literal

from pydantic import Field

from coec.schemas.heartbeat import LastWord
from coec.schemas.message import Message, Part, Text
from coec.schemas.replies import CalibrationResult, Count, Counts, Decision, Maybe6


class FetchedFile(Part):
    """A file in the folder."""

    name: Text = Field(description="path relative to the folder")
    sha256: Text = Field(description="hexadecimal")
    size_bytes: Count


class FetchedWindow(Part):
    """A window before or after the event."""

    window_id: Text
    sha256: Text = Field(description="hash of the file, equal to that in the vehicle's list")
    size_bytes: Count
    pairs: Count | None
    decision: Decision | None
    in_history: bool | None = Field(
        description="whether the result in the file is the one in the vehicle's history; null if one of them is missing"
    )


class Absent(Part):
    """Something that could not be fetched."""

    what: Text
    why: Text


class IncidentReport(Message):
    """`incident.json` in the folder, and what `coec fetch --json` prints."""

    folder: Text
    vehicle: Text
    pair: Text
    event_id: Text
    fetched_ns: Count = Field(description="wall clock of the fetching computer, ns since 1970")
    version: Text = Field(description="version of the program that fetched")
    files: tuple[FetchedFile, ...]
    windows: tuple[FetchedWindow, ...]
    entries: Count = Field(description="entries of the history around the event")
    chain_holds: bool | None = Field(
        description="whether each of these entries holds the hash of the one before it in its book, where both were "
        "fetched; null without two such entries"
    )
    absent: tuple[Absent, ...]


Level = Literal["ok", "warn", "fail"]


class Finding(Part):
    """One thing that was checked."""

    check: Text = Field(description="what was checked, one of a fixed set of words")
    level: Level = Field(description="fail: the service cannot work like this; warn: it can, but needs attention")
    where: Text = Field(description="file, endpoint, key or pair; empty for the computer as a whole")
    text: Text = Field(description="result of the check, one sentence")
    advice: Text | None = Field(default=None, description="what to do about it; null if there is nothing to do")


class DoctorReport(Message):
    """Everything that was checked; each finding depends only on those before it."""

    healthy: bool = Field(description="whether nothing failed; then the exit code is 0")
    findings: tuple[Finding, ...]


# --- many vehicles ----------------------------------------------------------------------------------------------------

AXES = ("rx_deg", "ry_deg", "rz_deg", "tx_m", "ty_m", "tz_m")
"""Columns of a correction, in order; with the prefix `sigma_` they hold its standard deviations."""

SEEN = (0.5, 0.5, 0.5, 0.1, 0.1, 0.1)
"""Steps, deg and m, that a monitor has to detect; drifts are measured in them."""


class WindowRow(Message):
    """A window of a batch, stored until it becomes a row of a table. It holds either a result or an error."""

    url: Text = Field(description="where the window was found; its name in the batch")
    sha256: Text | None = Field(description="hash of the whole file, hexadecimal; null if it could not be read")
    bytes: Count | None = Field(description="size of the file")
    vehicle: Text = Field(description="vehicle named in the window; empty if it names none")
    result: CalibrationResult | None = Field(default=None, description="what was decided; null with an error")
    recorded: Text | None = Field(default=None, description="sha256 of the result in the file, as canonical JSON")
    decided: Text | None = Field(default=None, description="sha256 of `result`; equals `recorded` if both agree")
    error_code: Text | None = Field(default=None, description="why there is no result, for programs")
    error: Text | None = Field(default=None, description="why there is no result, for people")
    seconds: float = Field(ge=0, description="wall-clock time of reading and solving")
    cpu_s: float = Field(ge=0, description="processor time of reading and solving")
    versions: dict[Text, Text] = Field(description="versions of the program and of the libraries it calculates with")


class BatchReport(Message):
    """What `coec batch --json` prints."""

    output: Text = Field(description="folder of the tables")
    windows: Count = Field(description="windows of the batch")
    kept: Count = Field(description="windows that were evaluated before this run")
    accepted: Count
    refused: Count
    errors: Counts = Field(description="windows without a result, by code")
    compared: Count = Field(description="windows that hold the result of their vehicle")
    differing: Count = Field(description="compared windows whose result differs now, to the byte")
    elapsed_s: float = Field(ge=0, description="duration of this run")
    cpu_s: float = Field(ge=0, description="processor time for this run's windows, in all processes")
    share_of_ideal: float | None = Field(
        description="time that this run's windows took, over cores × elapsed time: 1 if no core ever waited"
    )


class DayOfPair(Part):
    """Accepted windows of a pair on one day; null on axes that none of them determines."""

    date: Text = Field(description="UTC, such as 2026-11-22")
    windows: Count
    low: Maybe6 = Field(description="16th percentile of the correction; one standard deviation below if it is normal")
    middle: Maybe6 = Field(description="median of the correction")
    high: Maybe6 = Field(description="84th percentile of the correction")


class PairOfFleet(Part):
    """A pair of a vehicle over time. Corrections are from its nominal calibration."""

    vehicle: Text
    pair: Text
    windows: Count
    accepted: Count
    errors: Count = Field(description="windows without a result")
    last_ns: int | None = Field(description="stamp of the last window with a result, ns")
    latest: Maybe6 = Field(description="median of the last accepted windows; null on axes that they do not determine")
    drift: Maybe6 = Field(description="`latest` minus the median of as many windows that were accepted first")
    slope: Maybe6 = Field(description="slope of the corrections over time, per 30 days; null with windows of one day")
    worst: Text | None = Field(description="axis with the largest drift, in steps that a monitor has to detect")
    urgency: float = Field(ge=0, description="drift of that axis in such steps")
    days: tuple[DayOfPair, ...]


class FigureOfFleet(Part):
    """A figure of self-diagnosis over the accepted windows of all vehicles."""

    name: Text
    pair: Text
    vehicles: Count
    windows: Count
    low: float = Field(description="0.5 % of the windows are below")
    middle: float
    high: float = Field(description="0.5 % of the windows are above")


class ChangedWindow(Part):
    """A window whose decision changed."""

    vehicle: Text
    window_id: Text
    before: Text = Field(description="`accepted`, or codes of the reasons or of the error")
    now: Text
    rotation_deg: float | None = Field(description="largest difference of the corrections; null without two results")
    translation_m: float | None


class FleetChanges(Part):
    """Windows of two batches, matched by their hashes."""

    both: Count
    identical: Count = Field(description="to the byte")
    newly_accepted: Count
    newly_refused: Count
    newly_failing: Count = Field(description="with a result before, without one now")
    rotation_deg: float | None = Field(description="root mean square difference over windows accepted both times")
    translation_m: float | None
    windows: tuple[ChangedWindow, ...] = Field(description="changed decisions, largest differences first")


class FalseAlarms(Part):
    """Outcomes of the alarms of a fleet's pairs, according to their heartbeats."""

    pairs: Count = Field(description="pairs whose heartbeat counts alarms")
    watched_h: float = Field(ge=0, description="sensor time between completed checks, summed over all pairs, h")
    confirmed: Count = Field(description="alarms that ended with another extrinsic")
    withdrawn: Count = Field(description="false alarms: they ended with the extrinsic that they had rejected")
    per_100_h: float | None = Field(description="false alarms per 100 h of a pair; null if nothing was monitored")
    per_100_h_at_most: float | None = Field(description="upper bound of that rate, exceeded once in twenty (Poisson)")
    by_pair: dict[Text, Count] = Field(description="false alarms by vehicle/pair, for pairs that have any")


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


Connectivity = Literal["live", "parked", "silent"]


class PairNow(Part):
    """A pair of a vehicle. Nothing in it is newer than its latest heartbeat; ages are counted up to now."""

    word: LastWord
    standing: Connectivity = Field(
        description="`live`: its heartbeat is current; `parked`: its service announced the end; `silent`: its "
        "heartbeat is overdue, or its vehicle left without an announcement, and the state shown is the last known one"
    )
    said_s: float = Field(ge=0, description="age of its latest heartbeat, s")
    looked_s: float | None = Field(description="age of its last evaluated data, s; null before the first")
    worst: Literal["rx", "ry", "rz", "tx", "ty", "tz"] | None = Field(description="axis with the largest drift")
    urgency: float = Field(ge=0, description="drift of that axis, in steps that a monitor has to detect")


class FleetNow(Message):
    """Pairs of many vehicles, the most urgent first."""

    vehicles: Count
    known: Count = Field(description="pairs with a heartbeat")
    states: Counts = Field(description="live pairs by state; the others as `parked` and `silent`")
    matching: Count = Field(description="pairs that the filter accepts")
    pairs: tuple[PairNow, ...] = Field(description="the first of the matching pairs")
    refused: Counts = Field(description="heartbeats that were refused, by cause")
