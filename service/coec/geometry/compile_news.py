"""Tells listeners that kernels are being compiled, which happens once on a machine and takes about a minute. This
module imports no compiler itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Hearer = Callable[[str], None]
"""Called with the name of a kernel, on the compiling thread."""

_hearers: list[Hearer] = []
_on_end: list[Hearer] = []


def _nothing(_: str) -> None:
    pass


@contextmanager
def heard_by(hearer: Hearer, on_end: Hearer = _nothing) -> Iterator[None]:
    """Inside the context, `hearer` is called repeatedly while a kernel and those inside it are compiled, and `on_end`
    when all of them are, or when that failed. Kernels read from the cache cause no calls."""
    _hearers.append(hearer)
    _on_end.append(on_end)
    try:
        yield
    finally:
        _hearers.remove(hearer)
        _on_end.remove(on_end)


def tell(kernel: str) -> None:
    """Tell all hearers that a step of the compilation of this kernel begins."""
    for hearer in tuple(_hearers):
        hearer(kernel)


def end(kernel: str) -> None:
    """Reports that a kernel, and with it those inside it, is no longer being compiled."""
    for on_end in tuple(_on_end):
        on_end(kernel)
