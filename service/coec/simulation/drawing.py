"""Single frames of several drives, drawn by several processes before they have to be sent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager

from coec.simulation.parallel import spawned
from coec.simulation.rig_drive import RigConfig, RigDrive
from coec.simulation.schedule import Arrival
from coec.sources.recording import Message


class Drawers:
    """Processes that draw frames."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def draw(self, drive: int, entry: Arrival) -> Future[Message]:
        """Draws an entry of the plan of a drive; `drive` is the index of its configuration."""
        return self._executor.submit(_drawn, drive, entry)


@contextmanager
def drawing(configs: Sequence[RigConfig], processes: int) -> Iterator[Drawers]:
    """Drawers for the drives of these configurations. Each process builds its own street for every drive of which it
    draws a frame."""
    with spawned(processes, begin, tuple(configs)) as pool:
        yield Drawers(pool)


_configs: tuple[RigConfig, ...] = ()
_drives: dict[int, RigDrive] = {}


def begin(configs: tuple[RigConfig, ...]) -> None:
    """Prepares this process to draw frames of these drives."""
    global _configs  # one set of drives per process, as the pool's initializer gives it
    _configs = configs
    _drives.clear()


def _drawn(drive: int, entry: Arrival) -> Message:
    if drive not in _drives:
        _drives[drive] = _configs[drive].drive()
    return _drives[drive].message(entry)
