"""Reading windows of which nothing is known, a few MB at a time, by a thread that has other things to do."""

from __future__ import annotations

import hashlib
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from coec.adapters.mcap.windows import read_result
from coec.errors import WindowError
from coec.runtime.recording.window_index import WindowVersion
from coec.runtime.recording.window_store import WindowStore
from coec.schemas.replies import CalibrationResult

_log = logging.getLogger(__name__)


ROUND_S = 0.1
"""After this a round ends, however little was read: pairs may be waiting to be written, and the thread has to beat."""

PIECE_BYTES = 2**16
"""Read at once: 0.7 s on a disk that gives 100 kB/s."""


@dataclass(slots=True)
class _Reading:
    """The file that is being read; it stays the same file when another takes its name.

    Attributes:
        begun: what the file system said of it at the beginning.
    """

    path: Path
    stream: BinaryIO
    begun: os.stat_result
    result: CalibrationResult | None
    sha256: Any = field(default_factory=hashlib.sha256)


class DigestReader:
    """Reads what the store does not know of the windows of one pair: those that came by another way than its recorder
    and its worker, or whose line in the index was lost. Owned by one thread."""

    def __init__(self, store: WindowStore, pair: str, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: seconds that never go back."""
        self._clock = clock
        self._store = store
        self._pair = pair
        self._reading: _Reading | None = None
        self._unreadable: set[str] = set()

    def read(self, max_bytes: int) -> bool:
        """Go on by at most so many bytes, fewer when the disk is slow; the latest window comes first. False when there
        is nothing to read."""
        if self._reading is None:
            unread = self._store.unread(self._pair)
            self._unreadable.intersection_update(unread)
            window_id = next((one for one in unread if one not in self._unreadable), None)
            if window_id is None:
                return False
            path = self._store.path(window_id)
            self._guarded(path, lambda: self._begin(path))
        reading = self._reading
        if reading is not None:
            self._guarded(reading.path, lambda: self._go_on(reading, max_bytes))
        return True

    def close(self) -> None:
        """Leave the file that is being read."""
        if self._reading is not None:
            self._reading.stream.close()
            self._reading = None

    def _guarded(self, path: Path, step: Callable[[], None]) -> None:
        """A file that the disk does not give is left alone until the next start, one that has gone is no matter."""
        try:
            step()
        except FileNotFoundError:
            self.close()
        except OSError as error:
            self.close()
            self._unreadable.add(path.stem)
            _log.warning(f"a window cannot be read: {error.strerror}", extra={"fields": {"window": path.stem}})

    def _begin(self, path: Path) -> None:
        stream = path.open("rb")
        try:
            self._reading = _Reading(path, stream, os.fstat(stream.fileno()), _result_in(path))
        except BaseException:
            stream.close()
            raise

    def _go_on(self, reading: _Reading, max_bytes: int) -> None:
        end_s = self._clock() + ROUND_S
        while max_bytes > 0 and (data := reading.stream.read(min(max_bytes, PIECE_BYTES))):
            reading.sha256.update(data)
            max_bytes -= len(data)
            if self._clock() >= end_s:
                return
        if max_bytes <= 0:
            return
        status, begun = os.fstat(reading.stream.fileno()), reading.begun
        self.close()
        if (status.st_size, status.st_mtime_ns) != (begun.st_size, begun.st_mtime_ns):
            return  # somebody writes into it: it is read once more
        version = WindowVersion(
            size_bytes=status.st_size,
            modified_ns=status.st_mtime_ns,
            sha256=reading.sha256.hexdigest(),
            pairs=reading.result.pairs if reading.result else None,
            decision=reading.result.verdict.decision if reading.result else None,
        )
        self._store.note(reading.path.stem, version)
        self._store.flush()


def _result_in(path: Path) -> CalibrationResult | None:
    """None also for a damaged window, which is listed all the same: whoever wants to look into it can have it."""
    try:
        return read_result(path)
    except WindowError as error:
        _log.warning(f"a window is damaged: {error}", extra={"fields": {"window": path.stem}})
        return None
