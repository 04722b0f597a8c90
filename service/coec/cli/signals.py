"""How signals stop commands."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from coec.errors import ExitCode


@contextmanager
def until_signal() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set, so that a command can withdraw what it announced before it ends."""
    stop = threading.Event()

    def receive(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, receive) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def success_on_sigterm() -> Iterator[None]:
    """Ends the process with success on SIGTERM while a service is loaded, before it handles signals itself. The first
    process of a container has no default for a signal: the kernel would drop it, and the engine would wait for nothing.
    """

    def end(_number: int, _frame: FrameType | None) -> None:
        sys.exit(ExitCode.SUCCESS)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


LATER_S = 0.05
"""Delay until a lost Ctrl-C is sent again: by then the call that lost it has returned, or it loses it again."""


@contextmanager
def no_interrupt_lost() -> Iterator[None]:
    """Sends a lost Ctrl-C again a moment later. Python drops a Ctrl-C, with a traceback, if it arrives in a callback
    from C, for example from the compiler."""
    before = sys.unraisablehook

    def resend(what: sys.UnraisableHookArgs) -> None:
        if issubclass(what.exc_type, KeyboardInterrupt):
            # No `threading.Timer`: its start waits for its thread, and an interrupt within this hook is lost for good.
            _thread.start_new_thread(_interrupt_later, (threading.get_ident(),))
        else:
            before(what)

    sys.unraisablehook = resend
    try:
        yield
    finally:
        sys.unraisablehook = before


def _interrupt_later(thread: int) -> None:
    time.sleep(LATER_S)
    # A signal rather than `interrupt_main`, which does not wake a waiting thread.
    signal.pthread_kill(thread, signal.SIGINT)
