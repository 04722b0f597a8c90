"""The checks of the monitor at a pair, a JSON line each: what it saw on a drive, for whoever asks afterwards.

Only the newest are kept. Nothing is decided by them: a line that cannot be read is left out.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from pathlib import Path

from pydantic import ValidationError

from coec.adapters.files.durable import Log
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
        self._log = Log(path, limit, lambda: map(to_json, self._kept))
        self._load()

    def checks(self) -> tuple[CheckReply, ...]:
        """All that are kept."""
        with self._lock:
            return tuple(self._kept)

    def append(self, check: CheckReply) -> None:
        """Keep one more.

        Raises:
            StateError: it is kept in memory, but not on the disk; it goes there with the next.
        """
        with self._lock:
            self._kept.append(check)
            self._log.add(to_json(check))
            try:
                self._log.flush()
            except OSError as error:
                raise StateError(f"cannot write {self._path}: {error.strerror}") from error

    def _load(self) -> None:
        try:
            lines = self._log.load()
        except OSError:  # then it begins anew
            return
        for line in lines:
            with contextlib.suppress(ValidationError):
                self._kept.append(CheckReply.model_validate_json(line))
