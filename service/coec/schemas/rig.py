"""Documents of `coec sim rig-moves --json`: how well the sensors of a rig that moved are told, and how much better the
rig knows its pairs than they do by themselves."""

from __future__ import annotations

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.replies import Count, Vector6


class MovesRow(Part):
    """Drives with one kind of fault on one rig."""

    rig: str
    fault: str
    drives: Count
    right: Count = Field(description="drives on which exactly those that moved were named within the time allowed")
    undecided: Count = Field(description="on which not all of these were, and no other")
    wrong: Count = Field(description="on which ever one was named that had not moved")
    delay_s: tuple[float, ...] = Field(description="from the fault until all were named, of those that were, in order")


class JointRow(Part):
    """Windows of all pairs of a rig at one time, combined."""

    rig: str
    rigs: Count = Field(description="drawn")
    pairs: Count = Field(description="of one rig")
    rms_ratio: Vector6 = Field(description="rms error of the rig estimate over that of the windows, per axis")
    rms_ratio_all: float = Field(description="root of the mean of their squares")
    nees: float = Field(description="mean squared error of the rig estimate over what it claims, per axis: 1 is honest")
    consistent: Count = Field(description="rigs whose pairs were said to fit each other")
    biased_found: Count = Field(description="rigs, with one window 1° off, of which that window alone was left out")
    biased_missed: Count = Field(description="of which the pairs were said to fit each other all the same")


class RigMovesReport(Message):
    """What `coec sim rig-moves --json` prints."""

    allowed_s: float
    moves: tuple[MovesRow, ...]
    joint: tuple[JointRow, ...]
