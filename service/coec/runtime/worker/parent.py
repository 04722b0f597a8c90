"""What a process of the worker has to do with the process that started it."""

from __future__ import annotations

import signal

from coec.adapters.system.parent import die_with


def tie_to(parent: int) -> None:
    """Die with the parent thread that started this process; leave the signals of a terminal or a manager to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    die_with(parent)
