"""What was read of the windows on the disk, kept so that no file is read twice: the digest above all."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Iterable
from pathlib import Path

from pydantic import ValidationError

from coec.adapters.files.durable import Log
from coec.schemas.base import Part, to_json
from coec.schemas.replies import Decision

_log = logging.getLogger(__name__)

LINES = 1000
"""Of the file, 250 bytes each; from twice as many it is written anew, if not that many windows exist."""


class WindowVersion(Part):
    """One version of a window's file: with its result it is another than without.

    Attributes:
        size_bytes, modified_ns: as the file system says; they tell one version from another.
        sha256: of the whole file, hexadecimal.
        pairs: how many it holds; None when that cannot be read.
        decision: of the result that it holds; None when it holds none.
    """

    size_bytes: int
    modified_ns: int
    sha256: str
    pairs: int | None
    decision: Decision | None


class IndexedWindow(Part):
    """A line of the index. `order` counts the recordings, whatever any clock says."""

    window_id: str
    order: int
    version: WindowVersion


class WindowIndex:
    """A line for each version of a window that was read; the last of a window counts. Not safe from several threads,
    but for `flush`.

    A line that is lost costs that the window is read again, and that it is taken for the latest: the index is written
    at once, but no window is refused because it cannot be.
    """

    def __init__(self, path: Path) -> None:
        """`path`: a file of lines; need not exist."""
        self._known: dict[str, IndexedWindow] = {}
        self._log = Log(path, LINES, lambda: [to_json(known) for known in tuple(self._known.values())])
        self._waiting: deque[bytes] = deque()
        self._writing = threading.Lock()
        lines: list[bytes] = []
        with contextlib.suppress(OSError):  # then it begins anew
            lines = self._log.load()
        for line in lines:
            with contextlib.suppress(ValidationError):
                known = IndexedWindow.model_validate_json(line)
                self._known[known.window_id] = known
        self._next = 1 + max((known.order for known in self._known.values()), default=0)

    def get(self, window_id: str) -> IndexedWindow | None:
        """What is known of the latest version that was read; None: nothing."""
        return self._known.get(window_id)

    def next_order(self) -> int:
        """The place behind all recordings so far."""
        order, self._next = self._next, self._next + 1
        return order

    def put(self, known: IndexedWindow) -> None:
        """Another version was read; `flush` writes it."""
        self._known[known.window_id] = known
        self._waiting.append(to_json(known))

    def flush(self) -> None:
        """Write what was put. Safe from any thread, and for as long as the disk takes: who reads and puts meanwhile
        does not wait."""
        with self._writing:
            while self._waiting:
                self._log.add(self._waiting.popleft())
            try:
                self._log.flush()
            except OSError as error:
                _log.warning(f"the index of the windows cannot be written: {error.strerror}")

    def prune(self, window_ids: Iterable[str]) -> None:
        """Forget all windows but these."""
        for gone in self._known.keys() - set(window_ids):
            del self._known[gone]
