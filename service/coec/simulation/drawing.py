"""Single frames of several drives, drawn by several processes before they have to be sent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager

from coec.simulation.parallel import spawned
from coec.simulation.rig_drive import RigDrive, RigDriveConfig
from coec.simulation.schedule import Arrival
from coec.sources.recording import SensorMessage


class FrameRenderers:
    """Processes that draw frames."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def render(self, drive: int, entry: Arrival) -> Future[SensorMessage]:
        """Draws an entry of the plan of a drive; `drive` is the index of its configuration."""
        return self._executor.submit(_rendered, drive, entry)


@contextmanager
def frame_renderers(configs: Sequence[RigDriveConfig], processes: int) -> Iterator[FrameRenderers]:
    """Drawers for the drives of these configurations. Each process builds its own street for every drive of which it
    draws a frame."""
    with spawned(processes, prepare_process, tuple(configs)) as pool:
        yield FrameRenderers(pool)


_configs: tuple[RigDriveConfig, ...] = ()
_drives: dict[int, RigDrive] = {}


def prepare_process(configs: tuple[RigDriveConfig, ...]) -> None:
    """Prepares this process to draw frames of these drives."""
    global _configs  # one set of drives per process, as the pool's initializer gives it
    _configs = configs
    _drives.clear()


def _rendered(drive: int, entry: Arrival) -> SensorMessage:
    if drive not in _drives:
        _drives[drive] = _configs[drive].drive()
    return _drives[drive].message(entry)
