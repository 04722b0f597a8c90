"""What `coec doctor` finds."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from coec.schemas.base import Message, Part

Level = Literal["ok", "warn", "fail"]


class Finding(Part):
    """One thing that was looked at."""

    check: str = Field(description="what was looked at, one of a fixed set of words")
    level: Level = Field(description="fail: the service cannot do its work so; warn: it can, but see to it")
    where: str = Field(description="file, endpoint, key or pair; empty for the computer as a whole")
    text: str = Field(description="what was found, one sentence")
    advice: str | None = Field(default=None, description="what to do about it; null where nothing is to be done")


class DoctorReport(Message):
    """Everything that was looked at, in the order in which one thing depends on another."""

    healthy: bool = Field(description="whether nothing failed; the exit code is 0 then")
    findings: tuple[Finding, ...]
