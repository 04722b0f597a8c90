"""Ties a process of the worker to the process that started it."""

from __future__ import annotations

import signal

from coec.adapters.system.parent import die_with_parent


def tie_to(parent: int) -> None:
    """Lets this process die with the parent thread that started it, and ignore the signals of a terminal or a manager,
    which the parent handles."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    die_with_parent(parent)
