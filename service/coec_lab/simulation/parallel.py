"""Renders a drive with several processes, whole or frame by frame: Embree's binding holds Python's lock, so threads
would not share the work.
"""

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from typing import Any, Protocol

from coec.calibration.types import Frame
from coec_lab.simulation.drive import Arrival
from coec_lab.simulation.rig_drive import RigDrive, RigDriveConfig

PART = 128
"""Messages per piece of work: about 2 s of a drive at the usual rates, some 45 MB of sweeps to transfer."""


class Drive(Protocol):
    """A drive that can be made in parts."""

    @property
    def message_count(self) -> int:
        """How many `messages()` there are."""
        ...

    def messages(self) -> Iterator[Frame]:
        """All messages in the order of their stamps."""
        ...

    def part(self, begin: int, end: int) -> list[Frame]:
        """Messages `begin` to `end` (excluded) of `messages()`."""
        ...


class Driven(Protocol):
    """A configuration of a drive that can be sent to other processes."""

    def drive(self) -> Drive:
        """The drive that it describes."""
        ...


SPAWN = multiprocessing.get_context("spawn")

_drive: Drive | None = None
_left: Event | None = None
"""Set when nobody waits any more for what is being made."""


def messages_by(config: Driven, processes: int) -> Iterator[Frame]:
    """The messages of the drive, in the same order and the same to the byte as from its own `messages`.

    At most two pieces of work per process are in progress or waiting, whatever the length of the drive.
    """
    whole = config.drive()
    count = whole.message_count
    if processes == 1 or count <= PART:
        yield from whole.messages()
        return
    left = SPAWN.Event()
    with spawned(processes, _open, config, left) as pool:
        try:
            waiting: deque[Future[list[Frame]]] = deque()
            for begin in range(0, count, PART):
                waiting.append(pool.submit(_part, begin))
                if len(waiting) > 2 * processes:
                    yield from waiting.popleft().result()
            while waiting:
                yield from waiting.popleft().result()
        finally:  # also if the reader stops before the end
            left.set()


@contextmanager
def spawned(processes: int, begin: Callable[..., None], *given: Any) -> Iterator[ProcessPoolExecutor]:
    """Processes that each begin with a call of `begin`. At the end, work that still waits is cancelled, because nobody
    wants it any more."""
    # A compiled loop of one process must not take the cores of another. Numba reads this when it is imported there.
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = "1"
    try:
        pool = ProcessPoolExecutor(processes, mp_context=SPAWN, initializer=begin, initargs=given)
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)
    finally:
        if before is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = before


def _open(config: Driven, left: Event) -> None:
    global _drive, _left  # one drive per process, as the pool's initializer gives it
    _drive, _left = config.drive(), left


def _part(begin: int) -> list[Frame]:
    assert _drive is not None
    assert _left is not None
    made: list[Frame] = []
    while len(made) < PART and not _left.is_set():
        one = _drive.part(begin + len(made), begin + len(made) + 1)
        if not one:
            break
        made += one
    return made


class FrameRenderers:
    """Processes that draw frames."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def render(self, drive: int, entry: Arrival) -> Future[Frame]:
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


def _rendered(drive: int, entry: Arrival) -> Frame:
    if drive not in _drives:
        _drives[drive] = _configs[drive].drive()
    return _drives[drive].message(entry)
