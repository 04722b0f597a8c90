"""A thread that writes to the disk what other threads have noted in memory, so that only it has to wait.

A thread that has noted something notifies this one and goes on. If the disk is full, read-only or slow, only this one
waits. It tries again every second, together with whatever was noted meanwhile. A thread that has to know can ask
whether everything is on the disk; it waits no longer than a healthy disk needs.

Somebody may remove the folder and make it again while the service runs. Then all files are written again, from what
each has in memory: nothing counts as being on the disk because it was written into a folder that is gone.
"""

from __future__ import annotations

import errno
import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from coec.calibration.types import Reason
from coec.errors import StateError
from coec.io.system import ServiceThread

_log = logging.getLogger(__name__)

PATIENCE_S = 0.03
"""Longest wait for the disk. A healthy disk takes the lines and the state of a command, five fsyncs, within 20 ms;
commands are answered within 100 ms whatever the disk does."""

RETRY_S = 1.0
"""Time between two attempts, and between two looks at how full the disk is."""

SLOW_S = 1.0
"""A disk that takes longer than this for some kB is reported as slow."""

FULL_BYTES = 2**20
"""Free space below which an entry may not find room."""


class Persistable(Protocol):
    """Something that can be written to the disk."""

    def flush(self) -> None:
        """Write what was noted since the last time, and everything if the file is not there any more; may take as
        long as the disk does.

        Raises:
            StateError: it could not be written; the next call tries again.
        """


class DiskWriter:
    """Writes all files of one folder. `thread` writes; the methods are for any thread unless they say otherwise."""

    def __init__(self, folder: Path) -> None:
        self.thread = ServiceThread("disk-writer", self._run)
        self._folder = folder
        self._condition = threading.Condition()
        self._due: dict[Persistable, None] = {}
        self._registered: dict[Persistable, None] = {}
        self._report_replaced: list[Callable[[str], object]] = []
        self._notify_written: list[Callable[[], object]] = []
        self._pin = _Pin.of(folder)
        self._requested = self._written = 0
        self._started_s: float | None = None
        self._failure: Reason | None = None
        self._space: Reason | None = None

    def write(self, *items: Persistable) -> None:
        """Have these files written soon, in this order, because something was noted in them."""
        with self._condition:
            self._due.update(dict.fromkeys(items))
            self._registered.update(dict.fromkeys(items))
            self._requested += 1
            self._condition.notify_all()

    def register(self, *items: Persistable) -> None:
        """Have these files written, in this order and after all earlier ones, whenever the folder was removed and made
        again. Those that were ever written are kept anyway."""
        with self._condition:
            for item in items:
                self._registered.pop(item, None)
                self._registered[item] = None

    def on_replaced(self, report: Callable[[str], object]) -> None:
        """Call `report` with one sentence on this thread, before the files are written into another folder."""
        self._report_replaced.append(report)

    def on_written(self, notify: Callable[[], object]) -> None:
        """Call `notify` on this thread whenever files have been written."""
        self._notify_written.append(notify)

    def has_written(self, patience_s: float = PATIENCE_S) -> bool:
        """Whether everything noted before this call is on the disk. Waits at most `patience_s`, and not at all if the
        disk refuses, or if the write under way has already taken that long."""
        with self._condition:
            requested, end_s = self._requested, time.monotonic() + patience_s
            while self._written < requested:
                now_s = time.monotonic()
                rest_s = min(end_s, (now_s if self._started_s is None else self._started_s) + patience_s) - now_s
                if self._failure is not None or rest_s <= 0.0:
                    return False
                self._condition.wait(rest_s)
            return True

    @property
    def problem(self) -> Reason | None:
        """What is wrong with the disk; None if nothing is."""
        started_s, failure = self._started_s, self._failure
        silent_s = 0.0 if started_s is None else time.monotonic() - started_s
        if silent_s > SLOW_S:
            text = f"The disk of {self._folder} has been busy for {silent_s:.0f} s: decisions are not stored yet."
            return Reason("disk_slow", text)
        return failure or self._space

    def write_due(self) -> None:
        """Write the files that are due. For `thread`, or for use without a thread."""
        with self._condition:
            self._started_s = time.monotonic()
        self._notice_replacement()
        with self._condition:
            items, number = tuple(self._due), self._requested
            self._due.clear()
        failed: dict[Persistable, StateError] = {}
        for item in items:
            try:
                item.flush()
            except StateError as error:
                failed[item] = error
        self._notice_replacement()  # while the files were written: then they have to be written again
        with self._condition:
            self._started_s = None
            self._due = {**dict.fromkeys(failed), **self._due}
            if failed:
                text = f"{next(iter(failed.values()))}: it is kept in memory, and tried again every second."
                self._failure = Reason("disk_failing", text)
            else:
                self._failure, self._written = None, number
            self._condition.notify_all()
        for notify in self._notify_written:
            notify()

    def _notice_replacement(self) -> None:
        """Make all files due if the folder is another one than before."""
        try:
            there = self._folder.stat()
        except OSError:
            return  # the files cannot be written either, and say so
        if self._pin is not None and self._pin.holds(there):
            return
        before, self._pin = self._pin, _Pin.of(self._folder)
        if before is None:
            return
        text = (
            f"The folder {self._folder} was removed or replaced while the service ran. State, history, checks, events "
            "and baselines are written again from memory; recordings, and pictures of events, from before are gone."
        )
        _log.warning(text)
        for report in self._report_replaced:
            report(text)
        with self._condition:
            self._due = {**self._registered, **self._due}
            self._requested += 1

    def check_folder(self) -> None:
        """See whether the disk has room, and whether the folder is still the same. For `thread`, because
        on a disk that hangs even this waits."""
        self._notice_replacement()
        try:
            status = os.statvfs(self._folder)
        except OSError as error:
            self._space = Reason("disk_failing", f"The folder {self._folder} cannot be read: {error.strerror}.")
            return
        if status.f_flag & os.ST_RDONLY:
            text = f"The disk of {self._folder} is read-only ({os.strerror(errno.EROFS)}): nothing can be kept."
            self._space = Reason("disk_read_only", text)
        elif status.f_bavail * status.f_frsize < FULL_BYTES:
            text = f"The disk of {self._folder} is full: nothing can be kept. Free space."
            self._space = Reason("disk_full", text)
        else:
            self._space = None

    def _run(self, thread: ServiceThread) -> None:
        seen = -1
        while not thread.stopping:
            thread.beat()
            with self._condition:
                if self._requested == seen:
                    self._condition.wait(RETRY_S)
                seen = self._requested
            self.check_folder()
            if self._due:
                self.write_due()
        self.write_due()

    def request_stop(self) -> None:
        """Have the due files written once more, and end the thread."""
        self.thread.request_stop()
        with self._condition:
            self._condition.notify_all()


class _Pin:
    """An open folder. As long as it is open, no other folder gets the same number, even if it has been removed."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    @classmethod
    def of(cls, folder: Path) -> _Pin | None:
        """None if there is no such folder."""
        try:
            return cls(os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC))
        except OSError:
            return None

    def holds(self, status: os.stat_result) -> bool:
        """Whether this is the status of the folder."""
        return os.path.samestat(status, os.fstat(self._descriptor))

    def __del__(self) -> None:
        """Closes the folder."""
        os.close(self._descriptor)
