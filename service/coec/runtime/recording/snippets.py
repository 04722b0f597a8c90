"""Writes to the disk what a pair saw around an event, a few frames at a time, on a thread that has other work to do. A
failure here costs only the snippet."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

from coec.adapters.mcap.snippet_file import SnippetFile
from coec.adapters.system.logs import LossCounter
from coec.calibration.types import Rig
from coec.errors import RecordingError
from coec.runtime.ingest.decoder import Frame
from coec.runtime.ingest.frame_budget import frame_bytes
from coec.runtime.ingest.frame_ring import Snippet
from coec.runtime.recording.snippet_store import SnippetStore, snippet_id
from coec.schemas.replies import SnippetInfo

_log = logging.getLogger(__name__)

ROUND_S = 0.1
"""After this time a round ends: pairs of a window may wait to be written, and the thread must beat."""

ROUND_BYTES = 4 * 2**20
"""After so many bytes of frames a round ends, too: 30 ms at 150 MB/s."""

STOP_S = 2.0
"""Time for writing the rest when the service ends, s: some 200 MB on a healthy disk."""

OVERHEAD = 1.1
"""Largest ratio of the bytes of a file to those of its frames; the rest is headers, camera info, odometry, index."""


@dataclass(slots=True)
class _OpenSnippet:
    """The snippet that is being written, and the frames that are not in it yet."""

    name: str
    event: str
    stamp_ns: int
    file: SnippetFile
    left: deque[Frame]


class SnippetRecorder:
    """Records the snippets of one pair, one at a time. `give` is for any thread, everything else for the recorder's."""

    def __init__(
        self, rig: Rig, metadata: Mapping[str, str], store: SnippetStore, losses: LossCounter, *, packed: bool
    ) -> None:
        """`metadata` goes into every file, for example `vehicle`. `packed`: clouds and raw images are compressed."""
        self._rig = rig
        self._metadata = metadata
        self._store = store
        self._losses = losses
        self._packed = packed
        self._lock = threading.Lock()
        self._submitted: deque[Snippet] = deque()
        self._busy = False
        self._open: _OpenSnippet | None = None

    def submit(self, snippet: Snippet) -> None:
        """Has a snippet written. While another one is being written it is lost, because there is no memory for two."""
        with self._lock:
            busy, self._busy = self._busy, True
            if not busy:
                self._submitted.append(snippet)
        if busy:
            self._losses.add("window", "snippet_overrun")

    def resume(self, progress: Callable[[], None]) -> None:
        """Completes what earlier runs left unfinished; `progress` is called now and then."""
        try:
            self._store.resume(self._rig.pair, progress)
        except (RecordingError, OSError) as error:
            self._losses.add("window", "snippet_salvage_failed", detail=str(error))

    def write(self) -> bool:
        """Writes on for one round; False: there is nothing to write."""
        if not self._submitted and self._open is None:
            return False
        end_s, room = time.monotonic() + ROUND_S, ROUND_BYTES
        try:
            opened = self._begin(self._submitted.popleft()) if self._open is None else self._open
            while opened.left and room > 0 and time.monotonic() < end_s:
                frame = opened.left.popleft()
                opened.file.add(frame)
                room -= frame_bytes(frame)
            if not opened.left:
                self._finish(opened)
        except (RecordingError, OSError) as error:
            self._lose(error)
        return True

    def close(self) -> None:
        """Writes for at most `STOP_S` and finishes the file; for the end of the service."""
        end_s = time.monotonic() + STOP_S
        while time.monotonic() < end_s and self.write():
            pass
        if self._submitted or self._open is not None:
            self._losses.add("window", "snippet_cut_short", detail="the service was stopped")
        if self._open is not None:
            try:
                self._finish(self._open)
            except (RecordingError, OSError) as error:
                self._lose(error)

    def _begin(self, snippet: Snippet) -> _OpenSnippet:
        name = snippet_id(self._rig.pair, snippet.stamp_ns)
        self._store.make_room(round(OVERHEAD * sum(map(frame_bytes, snippet.frames))))
        metadata = {"snippet_id": name, "event": snippet.event, "stamp_ns": str(snippet.stamp_ns), **self._metadata}
        file = SnippetFile(self._store.path(name), self._rig, snippet.T_camera_lidar, metadata, packed=self._packed)
        self._open = _OpenSnippet(name, snippet.event, snippet.stamp_ns, file, deque(snippet.frames))
        return self._open

    def _finish(self, opened: _OpenSnippet) -> None:
        finished = opened.file.finish()
        self._open, self._busy = None, False
        info = SnippetInfo(
            snippet_id=opened.name,
            event=opened.event,
            stamp_ns=opened.stamp_ns,
            recorded_ns=finished.modified_ns,
            size_bytes=finished.bytes,
            sha256=finished.sha256,
        )
        fields = {"snippet": opened.name, "event": opened.event, "bytes": finished.bytes}
        _log.info("a snippet was recorded", extra={"fields": fields})
        self._store.add(info)

    def _lose(self, error: Exception) -> None:
        detail = error.strerror if isinstance(error, OSError) else str(error)
        self._losses.add("window", "snippet_failed", detail=detail or "the disk refused it")
        opened, self._open = self._open, None
        self._busy = False
        if opened is not None:
            with suppress(RecordingError, OSError):
                opened.file.abandon()
