"""A Ctrl-C is never lost."""

from __future__ import annotations

import ctypes
import signal
import threading
from collections.abc import Iterator

import pytest

from coec.cli import main as command_line
from coec.cli.main import no_interrupt_lost

DEADLINE_S = 60.0


@pytest.fixture
def _interruptible() -> Iterator[None]:
    """A shell has its background jobs ignore Ctrl-C, and the whole suite may be one."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.fault("Ctrl-C while a library calls back from C (the compiler does)", "it ends the command all the same")
@pytest.mark.usefixtures("_interruptible")
def test_ctrl_c_inside_a_call_from_c_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    # Long enough for a busy machine to return from the call before.
    monkeypatch.setattr(command_line, "LATER_S", 1.0)
    calls: list[int] = []

    def called_back() -> int:
        calls.append(1)
        signal.raise_signal(signal.SIGINT)
        return 0

    from_c = ctypes.CFUNCTYPE(ctypes.c_int)(called_back)

    def work() -> None:
        from_c()
        calls.append(2)
        # Ends when the interrupt comes again, or not at all.
        threading.Event().wait(DEADLINE_S)

    with pytest.raises(KeyboardInterrupt), no_interrupt_lost():
        work()
    assert calls == [1, 2], "the call itself drops it"
