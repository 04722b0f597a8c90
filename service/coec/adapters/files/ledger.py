"""The newest lines of a file: put down in memory by whoever has one, written by whoever may wait for a disk."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from coec.adapters.files.durable import Log

T = TypeVar("T")


class Ledger(Generic[T]):
    """Items in order, each a line of the file. Safe to use from several threads: only `load` and `flush` wait for the
    disk, and nobody waits for them."""

    def __init__(self, path: Path, limit: int, line_of: Callable[[T], bytes]) -> None:
        """
        Args:
            path: the file; its folder must exist.
            limit: items kept, the newest.
            line_of: the line of an item, without its end.
        """
        self._line_of = line_of
        self._limit = limit
        self._lock = threading.Lock()
        self._kept: deque[T] = deque(maxlen=limit)
        self._waiting: list[T] = []
        self._anew = False
        # Only whoever writes uses these.
        self._writing = threading.Lock()
        self._content: tuple[T, ...] = ()
        self._log = Log(path, limit, lambda: map(line_of, self._content))
        self._on_disk: tuple[T, ...] = ()

    def load(self) -> list[bytes]:
        """The whole lines of the file; see `Log.load`. To be called before the ledger is used by several threads, as
        `found`.

        Raises:
            OSError: it is there, but cannot be read; it will be written anew.
        """
        return self._log.load()

    def found(self, item: T) -> None:
        """An item was in the file."""
        self._kept.append(item)
        self._on_disk = tuple(self._kept)

    def renew(self) -> None:
        """The file is not what it shall be: the next `flush` writes it anew."""
        with self._lock:
            self._anew = True

    @property
    def durable(self) -> T | None:
        """The newest item that is on the disk; None before the first."""
        return self._on_disk[-1] if self._on_disk else None

    def on_disk(self) -> tuple[T, ...]:
        """All that are on the disk, oldest first."""
        return self._on_disk

    def items(self) -> tuple[T, ...]:
        """All that are kept, oldest first."""
        with self._lock:
            return tuple(self._kept)

    def add(self, make: Callable[[T | None], T]) -> T:
        """Keep one more, which `make` makes with the one before it; on the disk with the next `flush`."""
        with self._lock:
            item = make(self._kept[-1] if self._kept else None)
            self._kept.append(item)
            self._waiting.append(item)
            if len(self._waiting) > self._limit:  # a disk that hangs must not fill the memory
                self._waiting.clear()
                self._anew = True
            return item

    def flush(self) -> None:
        """Write what waits.

        Raises:
            OSError: it could not be written; it waits for the next call.
        """
        with self._writing:
            with self._lock:
                waiting, self._waiting = self._waiting, []
                anew, self._anew = self._anew, False
                self._content = tuple(self._kept)
            if anew:
                self._log.renew()
            for item in waiting:
                self._log.add(self._line_of(item))
            self._log.flush()
            self._on_disk = self._content
