"""The interface of an engine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from coec.errors import CoecError, ModelError
from coec.fleet.places import Job, StoreError
from coec.fleet.terms import ReplaySettings
from coec.schemas.fleet import WindowRow

PROCESS_DIED, DEADLINE, TOO_LARGE = "process_died", "deadline", "memory_exceeded"
"""Error codes of windows whose process ended or was ended."""

NODE_LOST = "node_lost"
"""Error code of a window that was with several machines, each of which was lost."""

NOT_ON_NODE = "not_on_node"
"""Error code of a window whose path exists on this machine, but not on the one that should judge it."""

COMMON_CAUSES: Mapping[str, str] = {
    StoreError.reply_code: "check the credentials, the address and the client package of the store",
    ModelError.reply_code: "install the file of the depth network at this path on every machine that judges windows, "
    "or name another network with --depth",
    NOT_ON_NODE: "use a folder that every node mounts at the same path, or URLs of a store",
}
"""Error codes whose cause is not the window, with what to do. Every other window on that machine fails in the same
way."""


class FleetError(CoecError):
    """A batch that cannot go on."""

    reply_code = "batch_failed"


@dataclass(frozen=True, slots=True)
class WorkerLimits:
    """Limits for the work on one window, and for failures.

    Attributes:
        seconds: longest wall time without a word of the process that has the window.
        bytes: largest memory of that process.
        alike: a process that fails with a common cause (`COMMON_CAUSES`) so many times in succession gets no more
            windows; None: such a failure is a row like any other.
    """

    seconds: float
    bytes: int
    alike: int | None = 3

    @property
    def deadline_message(self) -> str:
        """The error text for a window that took longer."""
        return f"it was not judged within {self.seconds:g} s (--deadline)"


class Engine(Protocol):
    """Judges windows on the same terms."""

    @property
    def cores(self) -> int:
        """How many windows are solved at a time."""

    def rows(self, jobs: Sequence[Job], settings: ReplaySettings) -> Iterator[WindowRow]:
        """A row for every window, as they are finished. A window that ends its process gets a row, too.

        Raises:
            FleetError: the engine itself fails, or windows could not be judged for a common cause. Those have no row.
        """

    def close(self) -> None:
        """Releases what the engine holds beside its processes; it is not used again."""
