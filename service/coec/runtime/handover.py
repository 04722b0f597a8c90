"""Hands work from one thread to another, which begins it in time or not at all."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Generic, TypeVar

from coec.errors import CoecError

T = TypeVar("T")


class BusyError(CoecError):
    """The service did not begin the work in time, so nothing was done; or the work has begun and has not ended."""

    reply_code = "busy"


class DeferredCall(Generic[T]):
    """One piece of work. The thread that owns the state calls `run`; the thread that wants the work waits in
    `result`."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work
        self._future: Future[T] = Future()

    def run(self) -> None:
        """Does the work, unless nobody waits for it any more. An exception of the work is raised in `result`."""
        if not self._future.set_running_or_notify_cancel():
            return
        try:
            self._future.set_result(self._work())
        except BaseException as error:
            self._future.set_exception(error)
            if not isinstance(error, Exception):
                raise

    def result(self, timeout_s: float) -> T:
        """Waits up to `timeout_s` for what the work returns. If it has begun by then, waits once more as long.

        Raises:
            BusyError: the work was not begun within `timeout_s` and will not be; or it was begun and has not ended.
        """
        try:
            return self._future.result(timeout_s)
        except TimeoutError:
            if self._future.cancel():
                raise BusyError("The service is busy; nothing was done. Ask again.") from None
        except CancelledError:
            raise BusyError("The service is stopping; nothing was done.") from None
        try:
            return self._future.result(timeout_s)
        except TimeoutError:
            raise BusyError("The work was begun and has not ended; `history` will say how it went.") from None
