"""The newest items of a log file: any thread adds them in memory, and a thread that may wait for the disk writes
them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from coec.adapters.files.durable import LineLog

T = TypeVar("T")


class AppendLog(Generic[T]):
    """Items in order, each a line of the file. Safe for use from several threads: only `load` and `flush` wait for the
    disk, and no other method waits for them."""

    def __init__(self, path: Path, limit: int, line_of: Callable[[T], bytes]) -> None:
        """
        Args:
            path: the file; its folder must exist.
            limit: number of items kept, the newest.
            line_of: the line of an item, without its end.
        """
        self._line_of = line_of
        self._limit = limit
        self._lock = threading.Lock()
        self._items: deque[T] = deque(maxlen=limit)
        self._waiting: list[T] = []
        self._anew = False
        # Only the writing thread uses these.
        self._writing = threading.Lock()
        self._content: tuple[T, ...] = ()
        self._log = LineLog(path, limit, lambda: map(line_of, self._content))
        self._on_disk: tuple[T, ...] = ()

    def load(self) -> list[bytes]:
        """The complete lines of the file; see `Log.load`. Call this and `found` before several threads use the ledger.

        Raises:
            OSError: the file exists but cannot be read; it will be rewritten.
        """
        return self._log.load()

    def restored(self, item: T) -> None:
        """Add an item that was found in the file."""
        self._items.append(item)
        self._on_disk = tuple(self._items)

    def renew(self) -> None:
        """Mark the file as wrong, so that the next `flush` rewrites it."""
        with self._lock:
            self._anew = True

    @property
    def durable(self) -> T | None:
        """The newest item that is on the disk; None before the first."""
        return self._on_disk[-1] if self._on_disk else None

    def on_disk(self) -> tuple[T, ...]:
        """All items on the disk, oldest first."""
        return self._on_disk

    def items(self) -> tuple[T, ...]:
        """All kept items, oldest first."""
        with self._lock:
            return tuple(self._items)

    def add(self, make: Callable[[T | None], T]) -> T:
        """Keep one more item, which `make` makes from the one before it. The next `flush` puts it on the disk."""
        with self._lock:
            item = make(self._items[-1] if self._items else None)
            self._items.append(item)
            self._waiting.append(item)
            if len(self._waiting) > self._limit:  # a disk that hangs must not fill the memory
                self._waiting.clear()
                self._anew = True
            return item

    def flush(self) -> None:
        """Write the waiting items.

        Raises:
            OSError: they could not be written; they wait for the next call.
        """
        with self._writing:
            with self._lock:
                waiting, self._waiting = self._waiting, []
                anew, self._anew = self._anew, False
                self._content = tuple(self._items)
            if anew:
                self._log.renew()
            for item in waiting:
                self._log.add(self._line_of(item))
            self._log.flush()
            self._on_disk = self._content
