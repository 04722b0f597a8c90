"""What is said of many windows that were judged again: a row each, and a summary of a batch.

Angles in degrees, lengths in metres, axes rx ry rz tx ty tz about and along the camera axes.
"""

from __future__ import annotations

from pydantic import Field

from coec.schemas.base import Message
from coec.schemas.replies import CalibrationResult, Count, Counts


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
