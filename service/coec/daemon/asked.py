"""What the process is asked from outside: to stop, to read its configuration again."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Signals:
    """What the process was asked from outside."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self.reread = threading.Event()

    def receive(self, number: int, _frame: FrameType | None) -> None:
        """A signal handler."""
        (self.reread if number == signal.SIGHUP else self.stop).set()


@contextmanager
def received() -> Iterator[Signals]:
    """Signals of the process while the daemon serves."""
    signals = Signals()
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = {number: signal.signal(number, signals.receive) for number in numbers}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
