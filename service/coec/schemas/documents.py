"""Documents that only commands print or write: the findings of `coec doctor`, and the report of `coec fetch` on an
incident.
"""

from typing import Literal

from pydantic import Field

from coec.schemas.message import Message, Part, Text
from coec.schemas.replies import Count, Decision


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
