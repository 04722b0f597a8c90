"""The signals by which the process is asked to stop, or to read its configuration again."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Signals:
    """Which signals have come: SIGHUP sets `reread`, every other one `stop`."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self.reread = threading.Event()

    def receive(self, number: int, _frame: FrameType | None) -> None:
        """The signal handler."""
        (self.reread if number == signal.SIGHUP else self.stop).set()


@contextmanager
def handled_signals() -> Iterator[Signals]:
    """Handles the signals of the process within the block, and restores the earlier handlers after it."""
    signals = Signals()
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = {number: signal.signal(number, signals.receive) for number in numbers}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
