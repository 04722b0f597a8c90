"""Tells listeners that kernels are being compiled, which happens once on a machine and takes about a minute. This
module imports no compiler itself."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Listener = Callable[[str], None]
"""Called with the name of a kernel, on the compiling thread."""

_listeners: list[Listener] = []
_on_end: list[Listener] = []


def _nothing(_: str) -> None:
    pass


@contextmanager
def listening(listener: Listener, on_end: Listener = _nothing) -> Iterator[None]:
    """Inside the context, `listener` is called repeatedly while a kernel and those inside it are compiled, and `on_end`
    when all of them are, or when that failed. Kernels read from the cache cause no calls."""
    _listeners.append(listener)
    _on_end.append(on_end)
    try:
        yield
    finally:
        _listeners.remove(listener)
        _on_end.remove(on_end)


def notify(kernel: str) -> None:
    """Tells all listeners that a step of the compilation of this kernel begins."""
    for listener in tuple(_listeners):
        listener(kernel)


def end(kernel: str) -> None:
    """Reports that a kernel, and with it those inside it, is no longer being compiled."""
    for on_end in tuple(_on_end):
        on_end(kernel)
