"""The log of the monitor's checks of a pair, one JSON line each, so that people can see afterwards how a drive went.

Only the newest are kept. No decision depends on them, so a line that cannot be read is left out.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from pydantic import ValidationError

from coec.adapters.files.ledger import AppendLog
from coec.errors import StateError
from coec.schemas.base import to_json
from coec.schemas.replies import CheckReply


class CheckLog:
    """The checks, oldest first. Safe to use from several threads; only `flush` waits for the disk."""

    def __init__(self, path: Path, limit: int) -> None:
        """`path` holds the checks of earlier runs; the newest `limit` are kept."""
        self._path = path
        self._ledger: AppendLog[CheckReply] = AppendLog(path, limit, to_json)
        self._load()

    def checks(self) -> tuple[CheckReply, ...]:
        """All checks that are kept."""
        return self._ledger.items()

    def on_disk(self) -> tuple[CheckReply, ...]:
        """All checks that are on the disk."""
        return self._ledger.on_disk()

    def append(self, check: CheckReply) -> None:
        """Appends a check; the next `flush` writes it."""
        self._ledger.add(lambda _: check)

    def flush(self) -> None:
        """Writes to the disk what is not there yet.

        Raises:
            StateError: the disk refuses; the next call tries again.
        """
        try:
            self._ledger.flush()
        except OSError as error:
            raise StateError(f"cannot write {self._path}: {error.strerror}") from error

    def _load(self) -> None:
        try:
            lines = self._ledger.load()
        except OSError:  # then the log begins anew
            return
        for line in lines:
            with contextlib.suppress(ValidationError):
                self._ledger.restored(CheckReply.model_validate_json(line))
