"""Threads whose death or standstill can be seen from outside."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)


class ServiceThread:
    """Runs `body(self)` until it returns. The body calls `beat()` in every round and returns soon after `stopping`.

    An exception that escapes the body ends the thread and is kept in `failure`, for the main loop to act on.
    """

    def __init__(self, name: str, body: Callable[[ServiceThread], None]) -> None:
        self.name = name
        self.failure: BaseException | None = None
        self._body = body
        self._stop = threading.Event()
        self._beat_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._beat_s = time.monotonic()
        self._thread.start()

    def beat(self) -> None:
        """The body has made progress."""
        self._beat_s = time.monotonic()

    @property
    def silence_s(self) -> float:
        """Seconds since the last beat."""
        return time.monotonic() - self._beat_s

    @property
    def stopping(self) -> bool:
        """Whether the body has been asked to return."""
        return self._stop.is_set()

    @property
    def dead(self) -> bool:
        """Whether the thread ended without having been asked to."""
        return self._thread.ident is not None and not self._thread.is_alive() and not self._stop.is_set()

    def request_stop(self) -> None:
        """Ask the body to return. If the body waits for more than a short timeout, the caller has to wake it."""
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the end; False if the thread still runs after `timeout_s`."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._body(self)
        except BaseException as error:
            self.failure = error
            _log.exception("a thread died", extra={"fields": {"thread": self.name}})
