"""Who hears that kernels are being compiled: once on a machine, for about a minute. Imports no compiler itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Hearer = Callable[[str], None]
"""Called with the name of a kernel, again and again while it is compiled, by the thread that does."""

_hearers: list[Hearer] = []


@contextmanager
def heard_by(hearer: Hearer) -> Iterator[None]:
    """Within, this hearer is told. Kernels that are read from the cache are no news."""
    _hearers.append(hearer)
    try:
        yield
    finally:
        _hearers.remove(hearer)


def tell(kernel: str) -> None:
    """A step of the compilation of this kernel begins."""
    for hearer in tuple(_hearers):
        hearer(kernel)
