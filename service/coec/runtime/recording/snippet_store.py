"""The folder of snippets: lists them, removes the oldest, and reads bytes of a file.

Beside each recording lies a description (`.json`), so that a listing opens no recording. The folder is bounded in
bytes. No snippet is begun if the disk has too little room, because windows come first.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from coec.adapters.files import durable
from coec.adapters.files.piece import read_piece
from coec.adapters.mcap.snippet_file import metadata_of, salvage_snippet
from coec.adapters.mcap.windows import PART_SUFFIX, REWRITE_SUFFIX, SUFFIX
from coec.errors import CoecError, DecodeError, NotFoundError, RecordingError
from coec.schemas.base import from_json, to_json
from coec.schemas.replies import SnippetInfo

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
            durable.make_folder(folder)
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
        return read_piece(self.path(name), "the snippet", offset, length)

    def add(self, info: SnippetInfo) -> None:
        """Lists a snippet that was recorded, once its description is on the disk and a restart would list it, too.

        Raises:
            OSError: the description could not be written; the next start finds the snippet by its file.
        """
        durable.replace(self._description_path(info.snippet_id), to_json(info))
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
            durable.make_folder(self._folder)
            while (oldest := self._oldest_beyond(size_bytes)) is not None:
                durable.remove(self.path(oldest))
                durable.remove(self._description_path(oldest))
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
        """Takes from the list what somebody has removed; for the scribe (`scribe.Book`)."""
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
