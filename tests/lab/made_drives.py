"""What other processes make of drives in tests: they import it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from coec.io.system import ONE_THREAD


def made(number: int, times: int) -> tuple[int, int, dict[str, str | None]]:
    """A number, the process that made it, and how many threads that was told to have."""
    return number * times, os.getpid(), {name: os.environ.get(name) for name in ONE_THREAD}


def died(number: int) -> int:
    """Drive 1 takes its process with it."""
    if number == 1:
        os._exit(9)
    return number


def started(folder: Path) -> None:
    """A drive that goes on for ever, once it has left the number of its process."""
    (folder / str(os.getpid())).touch()
    signal.pause()
