"""Logs as JSON on standard output, one line each, and counters whose log lines cannot flood it."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections import Counter
from datetime import UTC, datetime
from typing import TextIO

_LEVELS = {"debug": logging.DEBUG, "info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


class JsonFormatter(logging.Formatter):
    """One JSON object per record: time (UTC), level, logger, message, then what `extra={"fields": …}` gave."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one line; line breaks inside are escaped by JSON."""
        document: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        fields = getattr(record, "fields", None)
        if isinstance(fields, dict):
            document.update({key: value for key, value in fields.items() if key not in document})
        if record.exc_info:
            document["exception"] = self.formatException(record.exc_info)
        return json.dumps(document, ensure_ascii=False, default=str)


def configure(level: str, stream: TextIO | None = None) -> None:
    """Send every log record of the process to `stream` (standard output by default) as JSON lines.

    `level` is one of debug, info, warning, error.
    """
    handler = logging.StreamHandler(stream if stream is not None else sys.stdout)
    handler.setFormatter(JsonFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(_LEVELS[level])


class LossCounter:
    """Counts what was lost, by place and reason, and logs the first of each kind and then every 2^n-th.

    Reasons come from fixed sets, never from a sender. Safe to use from several threads.
    """

    def __init__(self, logger: logging.Logger, pair: str) -> None:
        self._logger = logger
        self._pair = pair
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()

    def add(self, place: str, reason: str, count: int = 1, detail: str = "") -> None:
        """Count `count` losses. `detail` is our own sentence; it must hold no text of the sender's."""
        with self._lock:
            before = self._counts[place, reason]
            after = before + count
            self._counts[place, reason] = after
        if after.bit_length() != before.bit_length():
            fields = {"pair": self._pair, "place": place, "reason": reason, "count": after}
            self._logger.warning(f"lost: {detail or reason}", extra={"fields": fields})

    def snapshot(self) -> dict[tuple[str, str], int]:
        """The counts so far: (place, reason) -> number."""
        with self._lock:
            return dict(self._counts)
