"""What other threads hand to the one that decides about a pair."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import TypeVar

from coec.runtime.handover import BusyError, Handover

T = TypeVar("T")

COMMANDS_WAITING = 16
"""Commands of people that may wait; more is a flood, and each is answered `busy`. Answers to questions have no bound of
their own: there are no more of them than questions, which the worker's queue bounds."""


class Mailbox:
    """First in, first out. Any thread posts and asks, one takes."""

    def __init__(self) -> None:
        self._items: deque[Callable[[], object]] = deque()
        self._commands = 0
        self._condition = threading.Condition()

    def post(self, work: Callable[[], object]) -> None:
        """Have `work` done; never waits."""
        with self._condition:
            self._items.append(work)
            self._condition.notify()

    def ask(self, work: Callable[[], T], timeout_s: float) -> T:
        """Have `work` done and wait for what it returns; what it raises is raised here.

        Raises:
            BusyError: too many wait, or it was not begun within `timeout_s`: nothing was done.
        """
        handed = Handover(work)
        with self._condition:
            if self._commands >= COMMANDS_WAITING:
                raise BusyError("Too many commands wait; nothing was done. Ask again.")
            self._commands += 1
            self._items.append(handed.run)
            self._condition.notify()
        try:
            return handed.result(timeout_s)
        finally:
            with self._condition:
                self._commands -= 1

    def wake(self) -> None:
        """Let a waiting `take` return."""
        with self._condition:
            self._condition.notify()

    def take(self, timeout_s: float) -> Callable[[], object] | None:
        """The next piece of work; None when nothing came within `timeout_s` or on `wake`."""
        with self._condition:
            if not self._items:
                self._condition.wait(timeout_s)
            return self._items.popleft() if self._items else None
