"""How commands are told to stop."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def until_signal() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set: what was announced is withdrawn before the end."""
    stop = threading.Event()

    def receive(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, receive) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


LATER_S = 0.05
"""Until a Ctrl-C that was lost comes again: the call of a library that lost it has returned by then, or loses it
again."""


@contextmanager
def no_interrupt_lost() -> Iterator[None]:
    """A Ctrl-C that falls into a call from C, of the compiler for instance, is dropped by Python with a traceback;
    within, it comes again a moment later."""
    before = sys.unraisablehook

    def hear(what: sys.UnraisableHookArgs) -> None:
        if issubclass(what.exc_type, KeyboardInterrupt):
            # No `threading.Timer`: its start waits for its thread, and an interrupt amid this hook is lost for good.
            _thread.start_new_thread(_interrupt_later, (threading.get_ident(),))
        else:
            before(what)

    sys.unraisablehook = hear
    try:
        yield
    finally:
        sys.unraisablehook = before


def _interrupt_later(thread: int) -> None:
    time.sleep(LATER_S)
    # A signal, and no `interrupt_main`, which wakes nobody who waits.
    signal.pthread_kill(thread, signal.SIGINT)
