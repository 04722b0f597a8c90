"""What is known of a fleet at this moment, from the last words of its pairs (`coec watch --once --json`)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.last_word import LastWord
from coec.schemas.replies import Count, Counts

Connectivity = Literal["live", "parked", "silent"]


class PairNow(Part):
    """A pair of a vehicle. Nothing in it is newer than its last word; ages are counted up to now."""

    word: LastWord
    standing: Connectivity = Field(
        description="`live`: its last word is current; `parked`: it said goodbye; `silent`: it is overdue, or its "
        "vehicle left without a goodbye, and the state shown is the last known one"
    )
    said_s: float = Field(ge=0, description="age of its last word, s")
    looked_s: float | None = Field(description="age of its last evaluated data, s; null before the first")
    worst: Literal["rx", "ry", "rz", "tx", "ty", "tz"] | None = Field(description="axis that drifted furthest")
    urgency: float = Field(ge=0, description="drift of that axis, in steps that a monitor has to detect")


class FleetNow(Message):
    """Pairs of many vehicles, the most urgent first."""

    vehicles: Count
    known: Count = Field(description="pairs with a last word")
    states: Counts = Field(description="live pairs by state; the others as `parked` and `silent`")
    matching: Count = Field(description="pairs that the filter lets through")
    pairs: tuple[PairNow, ...] = Field(description="the first of the matching pairs")
    refused: Counts = Field(description="last words that were refused, by cause")
