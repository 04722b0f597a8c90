"""The folder of recorded windows: what is there, what has to go, bytes of a file."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from coec.adapters.mcap.windows import PART_SUFFIX, REWRITE_SUFFIX, read_result
from coec.config import StateConfig
from coec.errors import CoecError, NotFoundError, RecordingError, UsageError
from coec.schemas.replies import WindowInfo

_log = logging.getLogger(__name__)

SECONDS_PER_DAY = 86_400.0
_WINDOW_ID = re.compile(r"([A-Za-z0-9_.-]{1,64})-(\d{1,19})", re.ASCII)


@dataclass(frozen=True, slots=True)
class Usage:
    """Bytes of all windows, and bytes free on their disk."""

    used: int
    free: int


class WindowFolder:
    """All windows of all pairs. Safe to use from several threads."""

    def __init__(self, folder: Path, config: StateConfig) -> None:
        """Makes the folder.

        Raises:
            RecordingError: it cannot be made.
        """
        self._folder = folder
        self._config = config
        self._lock = threading.Lock()
        self._known: dict[tuple[str, int, int], WindowInfo] = {}
        self._pairs_in: dict[str, int] = {}
        self._protected: dict[str, frozenset[str]] = {}
        self.removed = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for leftover in folder.glob(f"*.mcap{REWRITE_SUFFIX}"):  # the original is still there
                leftover.unlink(missing_ok=True)
        except OSError as error:
            raise RecordingError(f"cannot make the folder {folder}: {error.strerror}") from error

    def path(self, window_id: str) -> Path:
        """Where a window is, or will be."""
        return self._folder / f"{window_id}.mcap"

    def existing(self, pair: str, window_id: str) -> Path:
        """The file of a window of the pair.

        Raises:
            NotFoundError: no such window.
        """
        match = _WINDOW_ID.fullmatch(window_id)
        if match is None or match[1] != pair or not self.path(window_id).exists():
            raise NotFoundError(f"pair {pair} has no window of this id; the list is in `windows`")
        return self.path(window_id)

    def windows(self, pair: str) -> list[Path]:
        """Files of the pair's windows, by the sensor time of their beginning."""
        return [path for _, path in sorted(self._stamped(pair, ".mcap"))]

    def leftovers(self, pair: str) -> list[Path]:
        """Files of the pair that were not finished before the last end of the service."""
        return [path for _, path in sorted(self._stamped(pair, f".mcap{PART_SUFFIX}"))]

    def note(self, window_id: str, pairs: int) -> None:
        """Remember how many pairs a fresh window holds, for the list."""
        self._pairs_in[window_id] = pairs

    def protect(self, pair: str, window_ids: frozenset[str]) -> None:
        """These windows of the pair (and no others any more) are evidence: age does not remove them, and lack of room
        only when no other window is left."""
        with self._lock:
            self._protected[pair] = window_ids

    def usage(self) -> Usage:
        """How full it is."""
        return Usage(sum(size for _, size, _ in self._entries()), _free_bytes(self._folder))

    def make_room(self) -> None:
        """Before a window starts: remove windows that are too old, and the oldest while there are too many bytes or
        too little is left free. The newest window of a pair stays as long as its bytes are within the limit.

        Raises:
            RecordingError: too little is free all the same.
        """
        with self._lock:
            entries = sorted(self._entries())
            newest = entries[-1][2] if entries else None
            evidence = frozenset().union(*self._protected.values())
            used = sum(size for _, size, _ in entries)
            reserve = max((size for _, size, _ in entries), default=0)
            oldest_kept_ns = time.time_ns() - round(self._config.max_age_days * SECONDS_PER_DAY * 1e9)
            for modified_ns, size, path in sorted(entries, key=lambda entry: entry[2].stem in evidence):
                too_much = used + reserve > self._config.max_bytes
                too_full = _free_bytes(self._folder) < self._config.min_free_bytes + reserve
                too_old = modified_ns < oldest_kept_ns and path.stem not in evidence
                if not too_much and not (too_full and path != newest) and not too_old:
                    continue
                path.unlink(missing_ok=True)
                self.removed += 1
                used -= size
                _log.info("an old window was removed", extra={"fields": {"window": path.stem, "bytes": size}})
            free = _free_bytes(self._folder)
            if free < self._config.min_free_bytes:
                raise RecordingError(
                    f"only {free >> 20} MiB are free on the disk of {self._folder}; state.min_free_bytes asks for "
                    f"{self._config.min_free_bytes >> 20} MiB: free space"
                )

    def listing(self, pair: str) -> tuple[WindowInfo, ...]:
        """Every window of the pair, oldest first. Reads files that changed since the last call: may take a while."""
        infos = (self._info(path) for path in self.windows(pair))
        return tuple(info for info in infos if info is not None)

    def read(self, pair: str, window_id: str, offset: int, length: int) -> bytes:
        """`length` bytes of a window's file from `offset`; fewer at its end.

        Raises:
            NotFoundError: no such window.
            UsageError: the offset lies behind the end.
        """
        try:
            with self.existing(pair, window_id).open("rb") as stream:
                size = os.fstat(stream.fileno()).st_size
                if offset > size:
                    raise UsageError(f"`offset` lies behind the end of the file ({size} bytes)")
                stream.seek(offset)
                return stream.read(length)
        except OSError as error:
            raise NotFoundError(f"the window cannot be read: {error.strerror}") from error

    def _stamped(self, pair: str, suffix: str) -> list[tuple[int, Path]]:
        found = []
        for path in self._folder.glob(f"{pair}-*{suffix}"):
            match = _WINDOW_ID.fullmatch(path.name.removesuffix(suffix))
            if match is not None and match[1] == pair:
                found.append((int(match[2]), path))
        return found

    def _entries(self) -> list[tuple[int, int, Path]]:
        """(modified ns, bytes, path) of every window."""
        entries = []
        for path in self._folder.glob("*.mcap"):
            try:
                status = path.stat()
            except FileNotFoundError:
                continue
            entries.append((status.st_mtime_ns, status.st_size, path))
        return entries

    def _info(self, path: Path) -> WindowInfo | None:
        try:
            status = path.stat()
            key = (path.stem, status.st_mtime_ns, status.st_size)
            if key not in self._known:
                result = read_result(path)
                self._known[key] = WindowInfo(
                    window_id=path.stem,
                    sha256=_sha256(path),
                    size_bytes=status.st_size,
                    pairs=result.pairs if result else self._pairs_in.get(path.stem, 0),
                    decision=result.verdict.decision if result else None,
                )
            return self._known[key]
        except FileNotFoundError:
            return None
        except (CoecError, OSError):
            _log.exception("a window could not be listed", extra={"fields": {"window": path.stem}})
            return None


def start_ns_of(window_id: str) -> int:
    """Stamp of the pair that opened the window of this id."""
    return int(window_id.rpartition("-")[2])


def _free_bytes(folder: Path) -> int:
    return shutil.disk_usage(folder).free


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
