"""Keeps each of several processes to one core; otherwise the numeric libraries start a thread per core in each."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

THREAD_COUNT_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Environment variables that set how many threads a library starts; a library reads them when it is imported."""

ONE_THREAD = dict.fromkeys(THREAD_COUNT_VARIABLES, "1")
"""The environment of a process that keeps to one core."""


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started inside the context keep to one core each."""
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
