"""Reads windows that the store does not know yet, a few MB at a time, on a thread that has other work to do."""

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


DIGEST_ROUND_S = 0.1
"""After this time a round ends, however little was read: pairs may wait to be written, and the thread must beat."""

PIECE_BYTES = 2**16
"""Bytes that are read at once: 0.7 s on a disk that gives 100 kB/s."""


@dataclass(slots=True)
class _Reading:
    """The file that is being read. It stays open, even if another file takes its name.

    Attributes:
        begun: status of the file at the beginning.
    """

    path: Path
    stream: BinaryIO
    initial_status: os.stat_result
    result: CalibrationResult | None
    sha256: Any = field(default_factory=hashlib.sha256)


class DigestReader:
    """Reads the windows of one pair that the store does not know: those that neither its recorder nor its worker wrote,
    or whose line in the index was lost. Owned by one thread."""

    def __init__(self, store: WindowStore, pair: str, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a clock in seconds that never goes back."""
        self._clock = clock
        self._store = store
        self._pair = pair
        self._reading: _Reading | None = None
        self._unreadable: set[str] = set()

    def read(self, max_bytes: int) -> bool:
        """Reads on by at most `max_bytes`, fewer if the disk is slow. The latest window comes first. False: there is
        nothing to read."""
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
        """Closes the file that is being read."""
        if self._reading is not None:
            self._reading.stream.close()
            self._reading = None

    def _guarded(self, path: Path, step: Callable[[], None]) -> None:
        """Runs a step. A file that cannot be read is left alone until the next start; one that has gone is ignored."""
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
        end_s = self._clock() + DIGEST_ROUND_S
        while max_bytes > 0 and (data := reading.stream.read(min(max_bytes, PIECE_BYTES))):
            reading.sha256.update(data)
            max_bytes -= len(data)
            if self._clock() >= end_s:
                return
        if max_bytes <= 0:
            return
        status, initial = os.fstat(reading.stream.fileno()), reading.initial_status
        self.close()
        if (status.st_size, status.st_mtime_ns) != (initial.st_size, initial.st_mtime_ns):
            return  # somebody is writing into the file, so it is read again
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
    """The result in a window's file; None if it has none or is damaged. A damaged window is listed all the same, so
    that people can look into it."""
    try:
        return read_result(path)
    except WindowError as error:
        _log.warning(f"a window is damaged: {error}", extra={"fields": {"window": path.stem}})
        return None
