"""The report of `coec fetch`: what it fetched about a red event, and whether that matches what the vehicle has."""

from __future__ import annotations

from pydantic import Field

from coec.schemas.base import Message, Part, Text
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
