"""Logs on standard output, a line per record, as JSON or for people, and counters of losses that cannot flood the
log."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections import Counter
from datetime import UTC, datetime
from typing import Literal, TextIO

from coec.untrusted import json_printable, printable, printable_lines

Form = Literal["auto", "json", "human"]

_LEVELS = {"debug": logging.DEBUG, "info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


class JsonFormatter(logging.Formatter):
    """One JSON object per record: time (UTC), level, logger, message, then what `extra={"fields": …}` gave."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one line; line breaks and control characters inside are escaped by JSON."""
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
        return json_printable(json.dumps(document, ensure_ascii=False, default=str))


class HumanFormatter(logging.Formatter):
    """For a person at a terminal: local time, level unless it is `info`, message, then the fields. Control characters
    are escaped, so that text from a sender cannot move the cursor or make a second line."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one line, with the traceback below it if there is one."""
        time = datetime.fromtimestamp(record.created, UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
        level = "" if record.levelno == logging.INFO else f"{record.levelname.lower()}: "
        fields = getattr(record, "fields", None)
        told = "".join(f"  {key}={value}" for key, value in fields.items()) if isinstance(fields, dict) else ""
        line = printable(f"{time} {level}{record.getMessage()}{told}", None)
        if not record.exc_info:
            return line
        return f"{line}\n{printable_lines(self.formatException(record.exc_info))}"


def configure(level: str, form: Form, stream: TextIO | None = None) -> None:
    """Send every log record of the process to `stream` (standard output by default). Call again to change it.

    Args:
        level: one of debug, info, warning, error.
        form: `auto` means `human` if the stream is a terminal, else JSON lines.
    """
    to = stream if stream is not None else sys.stdout
    human = form == "human" or (form == "auto" and to.isatty())
    handler = logging.StreamHandler(to)
    handler.setFormatter(HumanFormatter() if human else JsonFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(_LEVELS[level])


class LossCounter:
    """Counts losses by place and reason, and logs the first of each kind and then every 2^n-th.

    Reasons come from fixed sets, never from a sender. Safe to use from several threads.
    """

    def __init__(self, logger: logging.Logger, name: str, kind: str = "pair") -> None:
        """`name` identifies in the log the pair, or another `kind` of thing, whose losses these are."""
        self._logger = logger
        self._whose = {kind: name}
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()

    def add(self, place: str, reason: str, count: int = 1, detail: str = "") -> None:
        """Count `count` losses. `detail` is a sentence of the program; it must hold no text from the sender."""
        with self._lock:
            before = self._counts[place, reason]
            after = before + count
            self._counts[place, reason] = after
        if after.bit_length() != before.bit_length():
            fields = {**self._whose, "place": place, "reason": reason, "count": after}
            self._logger.warning(f"lost: {detail or reason}", extra={"fields": fields})

    def snapshot(self) -> dict[tuple[str, str], int]:
        """The counts so far: (place, reason) -> number."""
        with self._lock:
            return dict(self._counts)
