"""The folder of recorded windows: lists them, removes old ones, and reads bytes of a file. Its index keeps what was
read of them, above all the digest, so that no file is read twice.

Queries about what is there are answered from memory and do not wait for the disk. Only threads that may wait for the
disk, those of the recorders, scan the folder (several times a second), write and remove.

No single clock decides whether a file is removed. The order of recording decides which window is older. A window is too
old only if the wall clock says so and also the sensor time of a newer window of its pair. Because both may jump
together, only a few windows at a time are removed for their age.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pydantic import ValidationError

from coec.config import StateConfig
from coec.errors import NotFoundError, RecordingError
from coec.io import storage
from coec.io.mcap.windows import SUFFIX, RecordedWindow
from coec.io.mcap.writer import PART_SUFFIX, REWRITE_SUFFIX
from coec.io.storage import LineLog, read_piece
from coec.schemas.message import Part, to_json
from coec.schemas.replies import Decision, RetentionReason, WindowInfo

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


NS_PER_DAY = 86_400 * 1_000_000_000

EXPIRED_AT_ONCE = 2
"""How many windows are removed for their age whenever one begins. More than one, so that the folder empties; few, so
that a clock that is wrong for an hour removes no more than twice what was recorded in that hour."""

SETTLED_S = 3.0
"""A folder that has not changed for this time, s, is not read again until its modification time changes. That time is
only as fine as the clock of the file system: 4 ms on ext4 and XFS, 2 s on FAT."""

_WINDOW_ID = re.compile(r"([A-Za-z0-9_.-]{1,64})-(\d{1,19})", re.ASCII)


@dataclass(frozen=True, slots=True)
class Usage:
    """Bytes of all windows, and bytes free on their disk."""

    used: int
    free: int


@dataclass(frozen=True, slots=True)
class _WindowFile:
    """A window in the folder: its pair, the sensor time of its beginning, its place in the order of recordings, and
    size and modification time of its file."""

    pair: str
    start_ns: int
    order: int
    size_bytes: int
    modified_ns: int


@dataclass(frozen=True, slots=True)
class _Listing:
    """The windows of one pair, valid until one comes or goes: all in order, and the ids of those that were not read
    yet, the latest first."""

    infos: tuple[WindowInfo, ...]
    unread: tuple[str, ...]

    def renewed(self, info: WindowInfo) -> _Listing:
        """The view with new information about one window. So a view of thousands is not made anew for each of them."""
        infos = tuple(info if one.window_id == info.window_id else one for one in self.infos)
        known = info.sha256 is not None
        return _Listing(infos, tuple(one for one in self.unread if one != info.window_id) if known else self.unread)


class WindowStore:
    """All windows of all pairs. Safe to use from several threads. The methods for recorders, and `read`, wait for the
    disk; `listing`, `usage`, `note`, `hold` and the like do not wait.

    Attributes:
        removed: number of windows that were removed.
    """

    def __init__(self, folder: Path, config: StateConfig) -> None:
        """Makes the folder. The index of its windows lies beside it.

        Raises:
            RecordingError: it cannot be made or read.
        """
        self._folder = folder
        self._config = config
        self._disk = threading.Lock()  # taken before `_lock`, where both are needed
        self._lock = threading.Lock()
        self._files: dict[str, _WindowFile] = {}
        self._views: dict[str, _Listing] = {}
        self._protected: dict[str, Mapping[str, RetentionReason]] = {}
        self._held: Counter[str] = Counter()
        self._changed_ns: int | None = None
        self._changed_s = self._scanned_s = 0.0
        self._free = 0
        self.removed = 0
        try:
            storage.make_folder(folder)
            for leftover in folder.glob(f"*{SUFFIX}{REWRITE_SUFFIX}"):  # the original is still there
                leftover.unlink(missing_ok=True)
            self._index = WindowIndex(folder.with_name(f"{folder.name}.jsonl"))
            self.scan()
        except OSError as error:
            raise RecordingError(f"the folder {folder} cannot be made or read: {error.strerror}") from error

    def reconfigure(self, config: StateConfig) -> None:
        """Keeps to these limits from the next window on."""
        with self._lock:
            self._config = config
            self._views.clear()

    # --- what is there ----------------------------------------------------------------------------------------------

    def path(self, window_id: str) -> Path:
        """Where a window is, or will be."""
        return self._folder / f"{window_id}{SUFFIX}"

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
        """Files of the pair's windows, in the order in which they were recorded."""
        self.scan()
        with self._lock:
            return [self.path(info.window_id) for info in self._view(pair).infos]

    def leftovers(self, pair: str) -> list[Path]:
        """Files of the pair that were not finished when the service last ended, in the order of the sensor time of
        their beginning."""
        parts = []
        for path in self._folder.glob(f"{pair}-*{SUFFIX}{PART_SUFFIX}"):
            match = _WINDOW_ID.fullmatch(path.name.removesuffix(f"{SUFFIX}{PART_SUFFIX}"))
            if match is not None and match[1] == pair:
                parts.append((int(match[2]), path))
        return [path for _, path in sorted(parts)]

    def usage(self) -> Usage:
        """How full the folder and its disk are."""
        with self._lock:
            return Usage(sum(file.size_bytes for file in self._files.values()), self._free)

    def listing(self, pair: str) -> tuple[WindowInfo, ...]:
        """Every window of the pair, oldest first. Opens no file: fields that have not been read yet are null."""
        with self._lock:
            return self._view(pair).infos

    def read(self, pair: str, window_id: str, offset: int, length: int) -> bytes:
        """`length` bytes of a window's file from `offset`; fewer at its end.

        Raises:
            NotFoundError: no such window.
            UsageError: the offset lies beyond the end.
        """
        return read_piece(self.existing(pair, window_id), "the window", offset, length)

    # --- what is known of it ----------------------------------------------------------------------------------------

    def add(self, recorded: RecordedWindow) -> None:
        """Takes in a window that was just recorded, as the latest."""
        version = WindowVersion(
            size_bytes=recorded.bytes,
            modified_ns=recorded.modified_ns,
            sha256=recorded.sha256,
            pairs=recorded.pairs,
            decision=None,
        )
        self.scan()
        with self._lock:
            file = self._files.get(recorded.window_id)
            if file is not None:
                file = self._files[recorded.window_id] = replace(file, order=self._index.next_order())
                self._index.put(IndexedWindow(window_id=recorded.window_id, order=file.order, version=version))
                self._views.clear()
        self.flush()

    def note(self, window_id: str, version: WindowVersion) -> None:
        """Notes the version of a window's file that was just read or written. The note counts only for a file of this
        size and time, so it does no harm if the file has changed since. The next `flush` writes it."""
        with self._lock:
            file = self._files.get(window_id)
            if file is not None:
                if version.modified_ns > file.modified_ns:  # written since the folder was looked at
                    size_bytes, modified_ns = version.size_bytes, version.modified_ns
                    file = self._files[window_id] = replace(file, size_bytes=size_bytes, modified_ns=modified_ns)
                self._index.put(IndexedWindow(window_id=window_id, order=file.order, version=version))
                view = self._views.get(file.pair)
                if view is not None:
                    protected_for = self._protected_windows().get(window_id)
                    self._views[file.pair] = view.renewed(self._info(window_id, file, protected_for))

    def flush(self) -> None:
        """Writes what was noted to the disk."""
        self._index.flush()

    def version(self, window_id: str) -> WindowVersion | None:
        """What was read of a window in its present version; None: not read yet, or no such window."""
        with self._lock:
            file = self._files.get(window_id)
            return None if file is None else self._version(window_id, file)

    def unread(self, pair: str) -> tuple[str, ...]:
        """Ids of the pair's windows of which not everything is known, the latest first."""
        self.scan()
        with self._lock:
            return self._view(pair).unread

    # --- what has to stay, what has to go ---------------------------------------------------------------------------

    def hold(self, window_id: str) -> None:
        """Protects a window from removal while work on it is under way, until `release` was called as often."""
        with self._lock:
            self._held[window_id] += 1

    def release(self, window_id: str) -> None:
        """Ends one `hold`."""
        with self._lock:
            self._held[window_id] -= 1
            if self._held[window_id] <= 0:
                del self._held[window_id]

    def protect(self, pair: str, protected_for: Mapping[str, RetentionReason]) -> None:
        """Protects these windows of the pair, and no others any more. Age does not remove them, and lack of room does
        so only if no other window may be removed. If all protected windows together have more than
        `max_protected_bytes`, the oldest of them count as ordinary ones."""
        with self._lock:
            if self._protected.get(pair) != protected_for:
                self._protected[pair] = dict(protected_for)
                self._views.clear()

    def make_room(self, progress: Callable[[], None]) -> None:
        """Called before a window starts: removes windows that are too old, and the oldest ones while there are too many
        bytes or too little is free. Held windows and the latest window of each pair stay, even if the limit is then
        exceeded.

        Args:
            progress: called after every window that is removed.

        Raises:
            RecordingError: too little is free even so, or a window cannot be removed.
        """
        try:
            self._make_room(progress)
        except OSError as error:
            raise RecordingError(f"no room can be made in {self._folder}: {error.strerror}") from error

    def _make_room(self, progress: Callable[[], None]) -> None:
        storage.make_folder(self._folder)
        self.scan()
        with self._lock:
            latest = {file.pair: window_id for window_id, file in self._in_order()}
            newest = {pair: self._files[window_id] for pair, window_id in latest.items()}
            removable = [item for item in self._in_order() if item[0] != latest[item[1].pair]]
            protected = self._protected_windows()
            used = sum(file.size_bytes for file in self._files.values())
            reserve = max((file.size_bytes for file in self._files.values()), default=0)
        expired = 0
        for window_id, file in sorted(removable, key=lambda item: item[0] in protected):
            too_much = used + reserve > self._config.max_bytes
            too_full = _free_bytes(self._folder) < self._config.min_free_bytes + reserve
            by_age = not too_much and not too_full
            if by_age and (expired == EXPIRED_AT_ONCE or not self._is_too_old(file, newest[file.pair])):
                continue
            if not self._remove(window_id, spare_protected=by_age or window_id not in protected):
                continue
            expired += by_age
            used -= file.size_bytes
            storage.sync_folder(self._folder)
            _log.info("an old window was removed", extra={"fields": {"window": window_id, "bytes": file.size_bytes}})
            progress()
        with self._lock:
            self._index.prune(self._files)
        free = _free_bytes(self._folder)
        if free < self._config.min_free_bytes:
            raise RecordingError(
                f"only {free >> 20} MiB are free on the disk of {self._folder}; state.min_free_bytes asks for "
                f"{self._config.min_free_bytes >> 20} MiB: free space"
            )

    def _remove(self, window_id: str, *, spare_protected: bool) -> bool:
        """Removes a window, unless it is held by now, has gone, or is to be spared."""
        with self._disk:
            with self._lock:
                spared = spare_protected and window_id in self._protected_windows()
                if spared or window_id in self._held or window_id not in self._files:
                    return False
                del self._files[window_id]
                self._views.clear()
            self._changed_ns = None  # if it cannot be removed, the next `scan` finds it again
            self.path(window_id).unlink(missing_ok=True)
            self.removed += 1
            return True

    def _is_too_old(self, file: _WindowFile, newest: _WindowFile) -> bool:
        """Whether both clocks say that a window is too old. A clock that was set back gives a negative age, which never
        counts as too old."""
        oldest_ns = round(self._config.max_age_days * NS_PER_DAY)
        by_wall_clock = time.time_ns() - file.modified_ns > oldest_ns
        return by_wall_clock and newest.start_ns - file.start_ns > oldest_ns

    # --- on threads that may wait for the disk ----------------------------------------------------------------------

    def scan(self) -> None:
        """Reads the folder if it has changed. No file in it is written in place: a changed window is replaced, and so
        the folder's modification time changes, too.

        Raises:
            OSError: the folder cannot be read.
        """
        with self._disk:
            now_s = time.monotonic()
            try:
                self._free = _free_bytes(self._folder)
                changed_ns = self._folder.stat().st_mtime_ns
                if changed_ns != self._changed_ns:
                    self._changed_ns, self._changed_s = changed_ns, now_s
                elif self._scanned_s > self._changed_s + SETTLED_S:
                    return
                self._scanned_s = now_s
                statuses = _statuses(self._folder)
            except FileNotFoundError:  # somebody has removed the folder
                self._changed_ns, statuses = None, {}
            with self._lock:
                self._compare(statuses)

    # --- inside; the lock is held -----------------------------------------------------------------------------------

    def _protected_windows(self) -> dict[str, RetentionReason]:
        """The protected windows and what each is kept for: the latest first, as many as `max_protected_bytes`
        allows."""
        requested = {window_id: reason for of_pair in self._protected.values() for window_id, reason in of_pair.items()}
        there = sorted(self._files.keys() & requested.keys(), key=lambda window_id: -self._files[window_id].order)
        left, protected = self._config.max_protected_bytes, dict[str, RetentionReason]()
        for window_id in there:
            left -= self._files[window_id].size_bytes
            if left < 0:
                break
            protected[window_id] = requested[window_id]
        return protected

    def _in_order(self) -> list[tuple[str, _WindowFile]]:
        return sorted(self._files.items(), key=lambda item: item[1].order)

    def _compare(self, statuses: Mapping[str, os.stat_result]) -> None:
        """Takes over the present content of the folder. A window that nobody has reported counts as the latest. Several
        of them are ordered by their times, because nothing else is known."""
        gone = self._files.keys() - statuses.keys()
        changed = [
            (status.st_mtime_ns, start_ns_of(window_id), window_id)
            for window_id, status in statuses.items()
            if (file := self._files.get(window_id)) is None
            or (file.size_bytes, file.modified_ns) != (status.st_size, status.st_mtime_ns)
        ]
        if not gone and not changed:
            return
        self._views.clear()
        for window_id in gone:
            del self._files[window_id]
        for modified_ns, start_ns, window_id in sorted(changed):
            pair, size_bytes = window_id.rpartition("-")[0], statuses[window_id].st_size
            self._files[window_id] = _WindowFile(pair, start_ns, self._order(window_id), size_bytes, modified_ns)
        self._index.prune(self._files)

    def _order(self, window_id: str) -> int:
        file, indexed = self._files.get(window_id), self._index.get(window_id)
        if file is not None:
            return file.order
        return self._index.next_order() if indexed is None else indexed.order

    def _version(self, window_id: str, file: _WindowFile) -> WindowVersion | None:
        indexed = self._index.get(window_id)
        if indexed is None:
            return None
        same = (indexed.version.size_bytes, indexed.version.modified_ns) == (file.size_bytes, file.modified_ns)
        return indexed.version if same else None

    def _view(self, pair: str) -> _Listing:
        view = self._views.get(pair)
        if view is None:
            ours = [(window_id, file) for window_id, file in self._in_order() if file.pair == pair]
            protected = self._protected_windows()
            infos = tuple(self._info(window_id, file, protected.get(window_id)) for window_id, file in ours)
            unread = tuple(info.window_id for info in reversed(infos) if info.sha256 is None)
            view = self._views[pair] = _Listing(infos, unread)
        return view

    def _info(self, window_id: str, file: _WindowFile, protected_for: RetentionReason | None) -> WindowInfo:
        version, indexed = self._version(window_id, file), self._index.get(window_id)
        return WindowInfo(
            window_id=window_id,
            sha256=version.sha256 if version else None,
            size_bytes=file.size_bytes,
            pairs=indexed.version.pairs if indexed else None,
            decision=version.decision if version else None,
            kept_for=protected_for,
        )


def start_ns_of(window_id: str) -> int:
    """Stamp of the pair that opened the window."""
    return int(window_id.rpartition("-")[2])


def _statuses(folder: Path) -> dict[str, os.stat_result]:
    """Status of every window's file, by window id."""
    statuses = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            window_id = entry.name.removesuffix(SUFFIX)
            if window_id != entry.name and _WINDOW_ID.fullmatch(window_id):
                try:
                    statuses[window_id] = entry.stat()
                except FileNotFoundError:
                    continue
    return statuses


def _free_bytes(folder: Path) -> int:
    """Bytes free on the disk that holds the folder, or will hold it once it is made."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(there).free
