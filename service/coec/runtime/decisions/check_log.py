"""The checks of the monitor at a pair, a JSON line each: what it saw on a drive, for whoever asks afterwards.

Only the newest are kept. Nothing is decided by them: a line that cannot be read is left out, and a check that a power
cut takes is gone.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from pathlib import Path

from pydantic import ValidationError

from coec.errors import StateError
from coec.schemas.base import to_json
from coec.schemas.replies import CheckReply


class CheckLog:
    """All that is kept, oldest first. Safe to use from several threads."""

    def __init__(self, path: Path, limit: int) -> None:
        """`path` holds the checks of earlier runs; the newest `limit` are kept."""
        self._path = path
        self._lock = threading.Lock()
        self._kept: deque[CheckReply] = deque(maxlen=limit)
        self._lines = 0
        self._load()

    def checks(self) -> tuple[CheckReply, ...]:
        """All that are kept."""
        with self._lock:
            return tuple(self._kept)

    def append(self, check: CheckReply) -> None:
        """Keep one more.

        Raises:
            StateError: it is kept in memory, but not on the disk.
        """
        with self._lock:
            self._kept.append(check)
            try:
                if self._lines >= 2 * (self._kept.maxlen or 1):
                    self._rewrite()
                else:
                    with self._path.open("ab") as stream:
                        stream.write(to_json(check) + b"\n")
                    self._lines += 1
            except OSError as error:
                raise StateError(f"cannot write {self._path}: {error.strerror}") from error

    def _load(self) -> None:
        try:
            data = self._path.read_bytes()
        except OSError:
            return
        lines = data.splitlines()
        for line in lines:
            with contextlib.suppress(ValidationError):
                self._kept.append(CheckReply.model_validate_json(line))
        self._lines = len(lines)
        if self._lines > len(self._kept) or not data.endswith(b"\n"):
            # Too many, or one that was torn: the next must not be written behind it.
            with contextlib.suppress(OSError):
                self._rewrite()

    def _rewrite(self) -> None:
        fresh = self._path.with_name(self._path.name + ".new")
        fresh.write_bytes(b"".join(to_json(check) + b"\n" for check in self._kept))
        fresh.replace(self._path)
        self._lines = len(self._kept)
