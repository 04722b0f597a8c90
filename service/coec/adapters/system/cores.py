"""One core for each of several processes: the libraries that calculate would start a thread for every core in each."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Variables that say how many threads a library starts; read when it is imported."""

ONE_THREAD = dict.fromkeys(THREADS, "1")
"""The environment of a process that keeps to one core."""


@contextmanager
def one_thread_each() -> Iterator[None]:
    """The processes that are begun in here keep to one core: the others have work of their own."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
