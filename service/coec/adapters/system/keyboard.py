"""Reads single keys from a terminal, without waiting for the end of a line."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

KEY_NAMES = {b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[5~": "page up", b"\x1b[6~": "page down", b"\r": "enter"}
"""What keys without a letter send (ECMA-48, as in xterm and the Linux console)."""

MAX_KEY_BYTES = 64
"""Bytes read at once, enough for a key that is held down."""


@contextmanager
def pressed_keys() -> Iterator[Callable[[float], str | None]]:
    """Yields `poll(wait_s)`, which returns the next pressed key or None. Afterwards the terminal is as before. Signals
    (Ctrl-C) work as usual. If standard input is no terminal, `poll` always returns None."""
    if not sys.stdin.isatty():
        yield lambda wait_s: _no_key(wait_s)
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor)
    try:
        yield lambda wait_s: _next_key(descriptor, wait_s)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _next_key(descriptor: int, wait_s: float) -> str | None:
    ready, _, _ = select.select([descriptor], [], [], wait_s)
    if not ready:
        return None
    data = os.read(descriptor, MAX_KEY_BYTES)
    return KEY_NAMES.get(data) or data[:1].decode("ascii", errors="ignore") or None


def _no_key(wait_s: float) -> str | None:
    select.select([], [], [], wait_s)
    return None
