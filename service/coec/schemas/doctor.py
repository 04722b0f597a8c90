"""What `coec doctor` finds."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from coec.schemas.base import Message, Part, Text

Level = Literal["ok", "warn", "fail"]


class Finding(Part):
    """One thing that was checked."""

    check: Text = Field(description="what was checked, one of a fixed set of words")
    level: Level = Field(description="fail: the service cannot work like this; warn: it can, but needs attention")
    where: Text = Field(description="file, endpoint, key or pair; empty for the computer as a whole")
    text: Text = Field(description="what was found, one sentence")
    advice: Text | None = Field(default=None, description="what to do about it; null if there is nothing to do")


class DoctorReport(Message):
    """Everything that was checked; each finding depends only on those before it."""

    healthy: bool = Field(description="whether nothing failed; then the exit code is 0")
    findings: tuple[Finding, ...]
