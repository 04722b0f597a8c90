"""The interface of an engine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from coec.errors import CoecError
from coec.fleet.places import Job
from coec.fleet.terms import Terms
from coec.schemas.fleet import WindowRow

PROCESS_DIED, DEADLINE, TOO_LARGE = "process_died", "deadline", "memory_exceeded"
"""Error codes of windows whose process ended or was ended."""


class FleetError(CoecError):
    """A batch that cannot go on."""

    reply_code = "batch_failed"


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits for the work on one window.

    Attributes:
        seconds: longest wall time without a word of the process that has the window.
        bytes: largest memory of that process.
    """

    seconds: float
    bytes: int

    @property
    def late(self) -> str:
        """The error text for a window that took longer."""
        return f"it was not judged within {self.seconds:g} s (--deadline)"


class Engine(Protocol):
    """Judges windows on the same terms."""

    @property
    def cores(self) -> int:
        """How many windows are solved at a time."""

    def rows(self, jobs: Sequence[Job], terms: Terms) -> Iterator[WindowRow]:
        """A row for every window, as they are finished. A window that ends its process gets a row, too.

        Raises:
            FleetError: the engine itself fails.
        """
