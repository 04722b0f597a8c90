"""Tells listeners that kernels are being compiled, which happens once on a machine and takes about a minute. This
module imports no compiler itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Hearer = Callable[[str], None]
"""Called with the name of a kernel, repeatedly while it is compiled, on the compiling thread."""

_hearers: list[Hearer] = []


@contextmanager
def heard_by(hearer: Hearer) -> Iterator[None]:
    """Inside the context, `hearer` is called for each step. Kernels read from the cache cause no calls."""
    _hearers.append(hearer)
    try:
        yield
    finally:
        _hearers.remove(hearer)


def tell(kernel: str) -> None:
    """Tell all hearers that a step of the compilation of this kernel begins."""
    for hearer in tuple(_hearers):
        hearer(kernel)
