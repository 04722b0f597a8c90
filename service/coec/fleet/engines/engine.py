"""What an engine is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from coec.errors import CoecError
from coec.fleet.places import Job
from coec.fleet.terms import Terms
from coec.schemas.fleet import WindowRow

PROCESS_DIED, DEADLINE, TOO_LARGE = "process_died", "deadline", "memory_exceeded"
"""Codes of windows with which their process ended."""


class FleetError(CoecError):
    """A batch that cannot go on."""

    reply_code = "batch_failed"


@dataclass(frozen=True, slots=True)
class Bounds:
    """Of the work on one window.

    Attributes:
        seconds: on the wall, without a word of the process that has it.
        bytes: that its process may hold.
    """

    seconds: float
    bytes: int

    @property
    def late(self) -> str:
        """What is said of a window that took longer."""
        return f"it was not judged within {self.seconds:g} s (--deadline)"


class Engine(Protocol):
    """Judges windows on the same terms."""

    @property
    def cores(self) -> int:
        """Windows that are solved at a time."""

    def rows(self, jobs: Sequence[Job], terms: Terms) -> Iterator[WindowRow]:
        """A row for every window, as they are finished. What one of them does to its process is a row as well.

        Raises:
            FleetError: the engine itself fails.
        """
