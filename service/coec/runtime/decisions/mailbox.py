"""The queue of work that other threads hand to the thread that decides about a pair."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import TypeVar

from coec.runtime.handover import BusyError, DeferredCall

T = TypeVar("T")

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
                raise BusyError("Too many commands wait; nothing was done. Ask again.")
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
