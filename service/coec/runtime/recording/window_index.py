"""The index of the windows on the disk. It keeps what was read of them, above all the digest, so that no file is read
twice."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Iterable
from pathlib import Path

from pydantic import ValidationError

from coec.adapters.files.durable import LineLog
from coec.schemas.base import Part, to_json
from coec.schemas.replies import Decision

_log = logging.getLogger(__name__)

INDEX_LINES = 1000
"""Lines of the index file, 250 bytes each. At twice as many it is written anew, unless that many windows exist."""


class WindowVersion(Part):
    """One version of a window's file: adding the result to it makes another version.

    Attributes:
        size_bytes, modified_ns: as the file system reports them; they tell versions apart.
        sha256: digest of the whole file, hexadecimal.
        pairs: number of pairs in the file; None if that cannot be read.
        decision: decision of the result in the file; None if it holds no result.
    """

    size_bytes: int
    modified_ns: int
    sha256: str
    pairs: int | None
    decision: Decision | None


class IndexedWindow(Part):
    """A line of the index. `order` counts the recordings and depends on no clock."""

    window_id: str
    order: int
    version: WindowVersion


class WindowIndex:
    """A line for each version of a window that was read; the last line of a window counts. Only `flush` is safe from
    several threads.

    The index is written at once, but a window is recorded even if its line cannot be written. If a line is lost, the
    window is read again and is taken for the latest.
    """

    def __init__(self, path: Path) -> None:
        """`path`: the index file; it need not exist."""
        self._known: dict[str, IndexedWindow] = {}
        self._log = LineLog(path, INDEX_LINES, lambda: [to_json(known) for known in tuple(self._known.values())])
        self._waiting: deque[bytes] = deque()
        self._writing = threading.Lock()
        lines: list[bytes] = []
        with contextlib.suppress(OSError):  # then the index begins anew
            lines = self._log.load()
        for line in lines:
            with contextlib.suppress(ValidationError):
                known = IndexedWindow.model_validate_json(line)
                self._known[known.window_id] = known
        self._next = 1 + max((known.order for known in self._known.values()), default=0)

    def get(self, window_id: str) -> IndexedWindow | None:
        """The line of the latest version that was read; None: there is none."""
        return self._known.get(window_id)

    def next_order(self) -> int:
        """The next place in the order of recordings."""
        order, self._next = self._next, self._next + 1
        return order

    def put(self, known: IndexedWindow) -> None:
        """Takes in another version that was read; `flush` writes it."""
        self._known[known.window_id] = known
        self._waiting.append(to_json(known))

    def flush(self) -> None:
        """Writes what was put, for as long as the disk takes. Safe from any thread; `get` and `put` do not wait
        meanwhile."""
        with self._writing:
            while self._waiting:
                self._log.add(self._waiting.popleft())
            try:
                self._log.flush()
            except OSError as error:
                _log.warning(f"the index of the windows cannot be written: {error.strerror}")

    def prune(self, window_ids: Iterable[str]) -> None:
        """Forgets all windows except these."""
        for gone in self._known.keys() - set(window_ids):
            del self._known[gone]
