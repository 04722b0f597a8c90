"""What `coec fetch` brings home of a red event, and whether that is what the vehicle had."""

from __future__ import annotations

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.replies import Count, Decision


class FetchedFile(Part):
    """A file in the folder."""

    name: str = Field(description="from the folder")
    sha256: str = Field(description="hexadecimal")
    size_bytes: Count


class FetchedWindow(Part):
    """A window before or after the event."""

    window_id: str
    sha256: str = Field(description="of the file, the one that the vehicle's list says")
    size_bytes: Count
    pairs: Count | None
    decision: Decision | None
    in_history: bool | None = Field(
        description="whether the result in the file is the one in the vehicle's history; null where one of the two is "
        "missing"
    )


class Absent(Part):
    """What is not in the folder."""

    what: str
    why: str


class IncidentReport(Message):
    """`incident.json` in the folder, and what `coec fetch --json` prints."""

    folder: str
    vehicle: str
    pair: str
    event_id: str
    fetched_ns: Count = Field(description="wall clock of who fetched, ns since 1970")
    version: str = Field(description="of the program that fetched")
    files: tuple[FetchedFile, ...]
    windows: tuple[FetchedWindow, ...]
    entries: Count = Field(description="of the history, around the event")
    chain_holds: bool | None = Field(
        description="whether each of these entries holds the hash of the one before it in its book, as far as both are "
        "here; null where there are no two"
    )
    absent: tuple[Absent, ...]
