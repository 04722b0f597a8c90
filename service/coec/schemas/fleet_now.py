"""What is known of a fleet at this moment, from the last words of its pairs (`coec watch --once --json`)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.last_word import LastWord
from coec.schemas.replies import Count, Counts

Standing = Literal["live", "parked", "silent"]


class PairNow(Part):
    """A pair of a vehicle. Nothing in it is newer than its last word; ages are by now."""

    word: LastWord
    standing: Standing = Field(
        description="`live`: it says so now; `parked`: it took its leave; `silent`: it is overdue, or its vehicle has "
        "gone without leave, and its state is that of then"
    )
    said_s: float = Field(ge=0, description="since it said this, s")
    looked_s: float | None = Field(description="age of its last evaluated data, s; null before the first")
    worst: Literal["rx", "ry", "rz", "tx", "ty", "tz"] | None = Field(description="axis that drifted furthest")
    urgency: float = Field(ge=0, description="drift of that axis, in multiples of what a monitor has to see")


class FleetNow(Message):
    """Pairs of many vehicles, the most urgent first."""

    vehicles: Count
    known: Count = Field(description="pairs that have said something")
    states: Counts = Field(description="pairs that are live, by state; `parked` and `silent` are the others")
    matching: Count = Field(description="pairs that the filter lets through")
    pairs: tuple[PairNow, ...] = Field(description="of them, the first")
    refused: Counts = Field(description="words that were not taken, by cause")
