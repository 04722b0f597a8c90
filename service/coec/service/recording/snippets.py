"""Snippets, the seconds that a pair recorded around an event: written to the disk a few frames at a time, on a thread
that has other work to do, and their folder, which is listed, bounded in bytes, and read from.

Beside each recording lies a description (`.json`), so that a listing opens no recording. No snippet is begun if the
disk has too little room, because windows come first. A failure here costs only the snippet.
"""

import hashlib
import logging
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from coec.calibration.types import Frame, Rig
from coec.errors import CoecError, DecodeError, NotFoundError, RecordingError
from coec.io import storage
from coec.io.logs import LossCounter
from coec.io.mcap.windows import SUFFIX
from coec.io.mcap.writer import PART_SUFFIX, REWRITE_SUFFIX, SnippetFile, metadata_of, salvage_snippet
from coec.schemas.message import from_json, to_json
from coec.schemas.replies import SnippetInfo
from coec.service.ingest.pair_stream import Snippet, frame_bytes

_log = logging.getLogger(__name__)

SNIPPET = ".snippet"
"""End of a snippet's id. A window's id ends in a digit."""

DESCRIPTION_SUFFIX = ".json"

MAX_DESCRIPTION_BYTES = 4096
"""Largest description of a snippet that is read, bytes; some 250 are written."""

PIECE_BYTES = 2**20
"""Bytes that are read at once of a file whose digest is not known."""


def snippet_id(pair: str, stamp_ns: int) -> str:
    """Id of the snippet of a pair, by the sensor time of the event."""
    return f"{pair}-{stamp_ns}{SNIPPET}"


class SnippetStore:
    """The snippets of all pairs. Safe to use from several threads; `listing` does not wait for the disk."""

    def __init__(self, folder: Path, max_bytes: int, min_free_bytes: int) -> None:
        """Makes the folder.

        Raises:
            RecordingError: it cannot be made or read.
        """
        self._folder = folder
        self._max_bytes, self._min_free_bytes = max_bytes, min_free_bytes
        self._lock = threading.Lock()
        self._infos: dict[str, SnippetInfo] = {}
        try:
            storage.make_folder(folder)
            for leftover in folder.glob(f"*{REWRITE_SUFFIX}"):  # the original is still there
                leftover.unlink(missing_ok=True)
            infos = [
                info
                for path in folder.glob(f"*{DESCRIPTION_SUFFIX}")
                if (info := self._read_description(path)) is not None
            ]
        except OSError as error:
            raise RecordingError(f"the folder {folder} cannot be made or read: {error.strerror}") from error
        self._infos = {info.snippet_id: info for info in sorted(infos, key=lambda info: info.recorded_ns)}

    def path(self, name: str) -> Path:
        """Where a snippet is, or will be."""
        return self._folder / f"{name}{SUFFIX}"

    def listing(self, pair: str) -> tuple[SnippetInfo, ...]:
        """Every snippet of the pair, oldest first."""
        with self._lock:
            return tuple(info for name, info in self._infos.items() if _pair_of(name) == pair)

    def read(self, pair: str, name: str, offset: int, length: int) -> bytes:
        """`length` bytes of a snippet's file from `offset`; fewer at its end.

        Raises:
            NotFoundError: no such snippet of the pair.
            UsageError: the offset lies beyond the end.
        """
        with self._lock:
            known = name in self._infos and _pair_of(name) == pair
        if not known:
            raise NotFoundError(f"pair {pair} has no snippet of this id; the list is in `windows`")
        return storage.read_piece(self.path(name), "the snippet", offset, length)

    def add(self, info: SnippetInfo) -> None:
        """Lists a snippet that was recorded, once its description is on the disk and a restart would list it, too.

        Raises:
            OSError: the description could not be written; the next start finds the snippet by its file.
        """
        storage.replace(self._description_path(info.snippet_id), to_json(info))
        with self._lock:
            self._infos.pop(info.snippet_id, None)
            self._infos[info.snippet_id] = info

    def make_room(self, size_bytes: int) -> None:
        """Makes room for a snippet of this size: removes the oldest ones while there are too many bytes.

        Raises:
            RecordingError: the snippet is larger than the limit for all, or the disk has too little room.
        """
        if size_bytes > self._max_bytes:
            raise RecordingError(f"a snippet of {size_bytes >> 20} MiB is more than snippets.max_bytes allows")
        try:
            storage.make_folder(self._folder)
            while (oldest := self._oldest_beyond(size_bytes)) is not None:
                storage.remove(self.path(oldest))
                storage.remove(self._description_path(oldest))
                with self._lock:
                    self._infos.pop(oldest, None)
            free = shutil.disk_usage(self._folder).free
        except OSError as error:
            raise RecordingError(f"no room can be made in {self._folder}: {error.strerror}") from error
        if free < self._min_free_bytes + size_bytes:
            raise RecordingError(
                f"only {free >> 20} MiB are free on the disk of {self._folder}: a snippet of {size_bytes >> 20} MiB is "
                f"not written beside the {self._min_free_bytes >> 20} MiB of state.min_free_bytes"
            )

    def flush(self) -> None:
        """Takes from the list what somebody has removed; for the disk writer (`Persistable`)."""
        with self._lock:
            listed = tuple(self._infos)
        gone = [name for name in listed if not self.path(name).exists()]
        with self._lock:
            for name in gone:
                self._infos.pop(name, None)

    def resume(self, pair: str, progress: Callable[[], None]) -> None:
        """Completes what earlier runs left of a pair: finishes files that were cut off, and reads those without a
        description. `progress` is called now and then.

        Raises:
            RecordingError, OSError: the disk refuses.
        """
        for part in self._folder.glob(f"{pair}-*{SNIPPET}{SUFFIX}{PART_SUFFIX}"):
            if _pair_of(part.name.removesuffix(f"{SUFFIX}{PART_SUFFIX}")) == pair:
                salvage_snippet(part, progress)
        for path in self._folder.glob(f"{pair}-*{SNIPPET}{SUFFIX}"):
            name = path.name.removesuffix(SUFFIX)
            if _pair_of(name) != pair or name in self._infos:
                continue
            with suppress(CoecError):  # a damaged file stays, so that people can look into it
                self.add(_read_again(path, name, progress))

    def _oldest_beyond(self, size_bytes: int) -> str | None:
        with self._lock:
            used = sum(info.size_bytes for info in self._infos.values())
            return next(iter(self._infos), None) if used + size_bytes > self._max_bytes else None

    def _description_path(self, name: str) -> Path:
        return self._folder / f"{name}{DESCRIPTION_SUFFIX}"

    def _read_description(self, path: Path) -> SnippetInfo | None:
        name = path.name.removesuffix(DESCRIPTION_SUFFIX)
        if path.stat().st_size > MAX_DESCRIPTION_BYTES:
            return None
        try:
            info = from_json(SnippetInfo, path.read_bytes())
        except DecodeError:
            return None
        return info if info.snippet_id == name and _pair_of(name) and self.path(name).exists() else None


def _pair_of(name: str) -> str:
    """The pair in a snippet's id; empty if `name` is no such id."""
    pair, _, stamp = name.removesuffix(SNIPPET).rpartition("-")
    return pair if name.endswith(SNIPPET) and stamp.isascii() and stamp.isdecimal() else ""


def _read_again(path: Path, name: str, progress: Callable[[], None]) -> SnippetInfo:
    metadata, digest = metadata_of(path), hashlib.sha256()
    with path.open("rb") as stream:
        while data := stream.read(PIECE_BYTES):
            digest.update(data)
            progress()
        status = os.fstat(stream.fileno())
    return SnippetInfo(
        snippet_id=name,
        event=metadata.get("event", ""),
        stamp_ns=int(name.removesuffix(SNIPPET).rpartition("-")[2]),
        recorded_ns=status.st_mtime_ns,
        size_bytes=status.st_size,
        sha256=digest.hexdigest(),
    )


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
    """Records the snippets of one pair, one at a time. `submit` is for any thread, everything else for the
    recorder's."""

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
