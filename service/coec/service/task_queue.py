"""Hands work from one thread to another: a call that is begun in time or not at all, and the queue of work for the
thread that manages a pair.
"""

import threading
from collections import deque
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
                raise BusyError("The service is busy; nothing was done. Retry.") from None
        except CancelledError:
            raise BusyError("The service is stopping; nothing was done.") from None
        try:
            return self._future.result(timeout_s)
        except TimeoutError:
            raise BusyError("The work was started and has not finished; see `history` for its result.") from None


COMMANDS_WAITING = 16
"""How many commands of people may wait; every further one is answered `busy`. Answers to questions need no bound here,
because the worker's queue bounds the questions."""


class TaskQueue:
    """A queue, first in, first out. Any thread posts and asks, one takes."""

    def __init__(self) -> None:
        self._items: deque[Callable[[], object]] = deque()
        self._commands = 0
        self._condition = threading.Condition()

    def post(self, work: Callable[[], object]) -> None:
        """Has `work` done; never waits."""
        with self._condition:
            self._items.append(work)
            self._condition.notify()

    def call_and_wait(self, work: Callable[[], T], timeout_s: float) -> T:
        """Has `work` done and waits for what it returns; an exception of the work is raised here.

        Raises:
            BusyError: too many commands wait, or the work was not begun within `timeout_s`, and nothing was done; or it
                has not ended.
        """
        call = DeferredCall(work)
        with self._condition:
            if self._commands >= COMMANDS_WAITING:
                raise BusyError("Too many commands are queued; nothing was done. Retry.")
            self._commands += 1
            self._items.append(call.run)
            self._condition.notify()
        try:
            return call.result(timeout_s)
        finally:
            with self._condition:
                self._commands -= 1

    def wake(self) -> None:
        """Let a waiting `take` return."""
        with self._condition:
            self._condition.notify()

    def take(self, timeout_s: float) -> Callable[[], object] | None:
        """The next piece of work; None if nothing came within `timeout_s`, or after `wake`."""
        with self._condition:
            if not self._items:
                self._condition.wait(timeout_s)
            return self._items.popleft() if self._items else None
