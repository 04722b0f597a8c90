"""Files of the service that survive a full disk and a power cut: atomic replacement, append-only logs, the checksummed
state file with its previous good copy, and reading a file piece by piece. When a function here returns, its effect
is on the disk. Files and folders are closed to other users from the beginning, and nothing is written through a
symbolic link.

When a function here returns, its effect is on the disk: the data of a file by fsync of the file, its name by fsync of
the folder. If the system refuses something, its `OSError` is raised. Then the files are as they were, or, if only the
last fsync failed, as they were meant to be, never in between. Nothing here is safe for use from several threads at
once.

Whatever the umask, files and folders that are made here are closed to other users of the machine from the beginning,
and nothing here writes through a symbolic link: a file of the service's own name that somebody has put there is
replaced.

The file is the canonical JSON (sorted keys, no spaces) of `{"body": …, "checksum": sha256 of the canonical body,
"schema_version": 1}`. A file counts as damaged unless it is byte for byte what this module would write for its body, so
that no flipped bit can be read as a calibration. An unusable file is kept beside the file that replaces it, as
`.broken`, or as `.newer` or `.older` if another version of the service wrote it.

All versions of the service so far write `schema_version` 1, so that each can read what the others wrote; what stands in
the body carries versions of its own. A file of a later schema version, whose checksum covers the version, too, is read
all the same, and is kept aside when it is replaced.
"""

import hashlib
import json
import os
import stat
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

from coec.errors import NotFoundError, StateError, UsageError

FRESH_SUFFIX = ".new"
"""Suffix of a file that is about to replace another. One that is found at a start is useless; the next replacement
overwrites it."""

PRIVATE, PRIVATE_FOLDER = 0o640, 0o750
"""Most permissions of the service's own files and folders: windows show streets, and the state decides what is served.
The umask of the process may take further ones away."""

BY_UMASK = 0o666
"""Permissions of files that a command writes for its user: as the umask says."""

MAX_QUARANTINED = 8
"""Most files of one name that are kept aside. The first ones tell most, and a disk that damages every file must not be
filled by them."""

_LINK_SUFFIX = ".link"
"""Suffix of the second name of a file that is about to become the previous copy."""


def replace(path: Path, data: bytes, previous: Path | None = None, mode: int = PRIVATE) -> None:
    """Make `data` the whole content of a file, atomically: at any moment the file has either the old or the new
    content.

    Args:
        path: the file; need not exist.
        previous: path that receives the replaced file, if there was one; None: it is not kept.
        mode: permissions of the new file, from which the umask takes its own.
    """
    fresh, link = _with_suffix(path, FRESH_SUFFIX), _with_suffix(path, _LINK_SUFFIX)
    try:
        _write_new(fresh, data, mode)
        if previous is not None:
            link.unlink(missing_ok=True)
            with suppress(FileNotFoundError):
                link.hardlink_to(path)
                link.replace(previous)
        fresh.replace(path)
        sync_folder(path.parent)
    finally:  # after a success only `link` may be left: renaming it onto another name of the same file does nothing
        for leftover in (fresh, link):
            with suppress(OSError):
                leftover.unlink(missing_ok=True)


def create(path: Path, mode: int = PRIVATE) -> int:
    """Create an empty file in place of whatever has its name, and return its descriptor, for writing. A link of that
    name is removed and not followed: who may write the folder could otherwise have another file overwritten."""
    path.unlink(missing_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)


def reopen(path: Path, mode: int = PRIVATE) -> int:
    """Open a file to read it and to append to it, and return its descriptor; it is created if it does not exist. If
    the name is a link, or another name of the same file exists, an empty file takes its place."""
    with suppress(FileNotFoundError):
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
            path.unlink()
    return os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, mode)


def publish(stream: BinaryIO, temporary: Path, final: Path) -> None:
    """Close a file that was written under a temporary name, and rename it once its data are on the disk."""
    stream.flush()
    os.fsync(stream.fileno())
    stream.close()
    temporary.replace(final)
    sync_folder(final.parent)


def add_name(path: Path, other: Path) -> None:
    """Give a file a second name, which must be free."""
    other.hardlink_to(path)
    sync_folder(other.parent)


def quarantine(path: Path, suffix: str) -> None:
    """Give a file that is about to be replaced a second name beside it: its name and `suffix`, then `suffix`-1, -2 and
    so on. Does nothing if the file does not exist. The first `MAX_QUARANTINED` are kept, and the newest of the
    later ones."""
    names = [
        _with_suffix(path, suffix),
        *(_with_suffix(path, f"{suffix}-{number}") for number in range(1, MAX_QUARANTINED + 1)),
    ]
    other = next((name for name in names if not name.exists()), names[-1])
    other.unlink(missing_ok=True)
    with suppress(FileNotFoundError):
        add_name(path, other)


def remove(path: Path) -> None:
    """Remove a file, if it exists."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def remove_folder(folder: Path) -> None:
    """Remove a folder of files, if it exists."""
    with suppress(FileNotFoundError):
        for path in sorted(folder.iterdir()):
            path.unlink(missing_ok=True)
        folder.rmdir()
        sync_folder(folder.parent)


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents, with the permissions `PRIVATE_FOLDER`."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    with suppress(FileExistsError):
        folder.mkdir(PRIVATE_FOLDER)
    sync_folder(folder)  # raises if the name belongs to something that is no folder
    sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class LineLog:
    """A file of lines that grows at its end and is rewritten when it has become too long.

    The log knows how many bytes of the file are sound. Anything behind them, left by a failed write of this process or
    by the end of an earlier one, is cut off before more is written. Lines that could not be written wait and go to the
    disk in order with the next. If somebody else has removed, replaced or truncated the file, the next `flush` rewrites
    it, even if no line waits.
    """

    def __init__(self, path: Path, limit: int, content: Callable[[], Iterable[bytes]]) -> None:
        """Nothing is read or written yet.

        Args:
            path: the file; its folder must exist.
            limit: number of lines; a file with twice as many is rewritten.
            content: returns all lines that the file should hold, from the owner's memory, including the waiting ones;
                called when the file is rewritten.
        """
        self._path = path
        self._limit = limit
        self._content = content
        self._sound_bytes = 0
        self._identity: tuple[int, int] | None = None
        self._lines = 0
        self._longest = 2 * limit
        self._waiting: list[bytes] = []
        self._anew = False
        self._named = False

    @property
    def waiting(self) -> bool:
        """Whether a line is not on the disk yet, or the file has to be rewritten."""
        return bool(self._waiting) or self._anew

    def load(self) -> list[bytes]:
        """The complete lines of the file, without line ends; empty if there is no file. A torn last line is left out.

        Raises:
            OSError: the file exists but cannot be read; it will be rewritten.
        """
        self._anew = True
        try:
            data = self._path.read_bytes()
            self._identity = _identity_of(self._path)
        except FileNotFoundError:
            data = b""
        self._anew = False
        self._sound_bytes = data.rfind(b"\n") + 1
        lines = data[: self._sound_bytes].split(b"\n")[:-1]
        self._lines = len(lines)
        return lines

    def renew(self) -> None:
        """Mark the file as wrong, so that the next `flush` rewrites it from `content`."""
        self._anew = True

    def add(self, line: bytes) -> None:
        """Add a line (without its end) to those that wait for `flush`."""
        self._waiting.append(line)
        if len(self._waiting) > self._limit:  # a disk that stays full must not fill the memory
            self._waiting.clear()
            self._anew = True

    def flush(self) -> None:
        """Write the waiting lines.

        Raises:
            OSError: they could not be written; they wait for the next call.
        """
        too_long = self._lines + len(self._waiting) > self._longest
        if self._anew or too_long or self._is_lost():
            self._rewrite()
            return
        if not self._waiting:
            return
        data = _joined(self._waiting)
        self._write(data)
        self._sound_bytes += len(data)
        self._lines += len(self._waiting)
        self._waiting.clear()

    def _rewrite(self) -> None:
        self._anew = True  # if the last fsync fails, it is not known whether the old or the new file is there
        lines = list(self._content())
        data = _joined(lines)
        replace(self._path, data)
        self._anew = False
        self._waiting.clear()
        self._sound_bytes, self._lines = len(data), len(lines)
        self._identity = _identity_of(self._path)
        self._longest = 2 * max(self._limit, len(lines))

    def _is_lost(self) -> bool:
        """Whether somebody else has truncated, replaced or removed the file."""
        try:
            status = self._path.lstat()
        except FileNotFoundError:
            return self._identity is not None
        # The number of a file that was removed may be that of a link in its place.
        own = stat.S_ISREG(status.st_mode) and (status.st_dev, status.st_ino) == self._identity
        return not own or status.st_size < self._sound_bytes

    def _write(self, data: bytes) -> None:
        """Write behind the sound bytes. If that fails, truncate to them; if that fails, too, the next write does it."""
        descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, PRIVATE)
        try:
            status = os.fstat(descriptor)
            self._identity = (status.st_dev, status.st_ino)
            try:
                if status.st_size > self._sound_bytes:
                    os.ftruncate(descriptor, self._sound_bytes)
                _write_at(descriptor, data, self._sound_bytes)
                os.fsync(descriptor)
            except OSError:
                with suppress(OSError):
                    os.ftruncate(descriptor, self._sound_bytes)
                raise
        finally:
            os.close(descriptor)
        if not self._named:  # once per process, as an earlier one may not have got this far
            sync_folder(self._path.parent)
            self._named = True


def _identity_of(path: Path) -> tuple[int, int]:
    """Device and number of a file, or of a link in its place."""
    status = path.lstat()
    return status.st_dev, status.st_ino


def _write_new(path: Path, data: bytes, mode: int) -> None:
    descriptor = create(path, mode)
    try:
        _write_at(descriptor, data, 0)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_at(descriptor: int, data: bytes, at: int) -> None:
    """Write all of `data`; a single call may write less, and on a full disk the next one then fails."""
    view = memoryview(data)
    while view:
        count = os.pwrite(descriptor, view, at)
        view, at = view[count:], at + count


def _joined(lines: Iterable[bytes]) -> bytes:
    return b"".join(line + b"\n" for line in lines)


def _with_suffix(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


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
        """The complete lines of the file; see `LineLog.load`. Call this and `restored` before several threads use the
        ledger.

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


SCHEMA_VERSION = 1

MAX_STATE_BYTES = 64 * 2**20
"""Largest file that is read. 32 pairs with everything that their state can hold take less than 1 MB."""

BROKEN, NEWER, OLDER = ".broken", ".newer", ".older"
"""Suffixes of files kept aside: damaged, or written by a newer or an older version of the service."""


@dataclass(frozen=True, slots=True)
class LoadedState:
    """What was found. `body` is None if there was no good copy; `damage` holds one sentence per bad copy."""

    body: dict[str, Any] | None
    damage: tuple[str, ...]


class _NewerError(StateError):
    """A copy that a later version of the service wrote."""


class StateFile:
    """One state file. Not safe for use from several threads at once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._previous = path.with_name(path.name + ".previous")
        self._current_is_good = False
        self._loaded: Path | None = None
        self._quarantined: dict[Path, str] = {}

    def load(self) -> LoadedState:
        """The body of the current copy, else of the previous one, else None. Never raises for a bad file."""
        damage = []
        for path in (self._path, self._previous):
            try:
                body, version = _decode(_read(path))
            except FileNotFoundError:
                continue
            except OSError as error:
                damage.append(f"{path.name}: {error.strerror}")
            except StateError as error:
                damage.append(f"{path.name}: {error}")
                self._quarantined[path] = NEWER if isinstance(error, _NewerError) else BROKEN
            else:
                self._current_is_good, self._loaded = path == self._path, path
                if version > SCHEMA_VERSION:
                    self._quarantined[path] = NEWER
                return LoadedState(body, tuple(damage))
        return LoadedState(None, tuple(damage))

    def exists(self) -> bool:
        """Whether there is a current copy, good or not."""
        return self._path.exists()

    def reject(self, suffix: str = BROKEN) -> None:
        """Call this if the loaded body, or a part of it, turns out to be unusable: the copy that it came from is kept
        aside under `suffix` and does not become the previous copy. `BROKEN` outweighs the other suffixes."""
        if self._loaded is None:
            return
        if self._quarantined.get(self._loaded) != BROKEN:
            self._quarantined[self._loaded] = suffix
        self._current_is_good = False

    def save(self, body: dict[str, Any]) -> None:
        """Replace the file; the replaced copy, if good, becomes the previous one. Unusable copies that were found are
        kept aside first. On the disk when this returns.

        Raises:
            StateError: the disk is full or the folder not writable; a good copy stays on the disk.
        """
        try:
            for path in tuple(self._quarantined):
                quarantine(path, self._quarantined[path])
                del self._quarantined[path]
            replace(self._path, _encode(body), self._previous if self._current_is_good else None)
        except OSError as error:
            raise StateError(f"cannot write {self._path}: {error.strerror}; it needs space and permission") from error
        self._current_is_good, self._loaded = True, self._path


def _encode(body: dict[str, Any], version: int = SCHEMA_VERSION) -> bytes:
    """Canonical JSON of the body in its envelope."""
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    # The checksum of later versions covers the version: else one flipped bit would turn version 1 into a later one.
    covered = text if version == 1 else f'{{"body":{text},"schema_version":{version}}}'
    checksum = hashlib.sha256(covered.encode()).hexdigest()
    return f'{{"body":{text},"checksum":"{checksum}","schema_version":{version}}}'.encode()


def _read(path: Path) -> bytes:
    with path.open("rb") as stream:
        data = stream.read(MAX_STATE_BYTES + 1)
    if len(data) > MAX_STATE_BYTES:
        raise StateError(f"has more than {MAX_STATE_BYTES} bytes")
    return data


def _decode(data: bytes) -> tuple[dict[str, Any], int]:
    """The body, and the schema version of the envelope."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise StateError("is not JSON") from error
    body = document.get("body") if isinstance(document, dict) else None
    if not isinstance(body, dict):
        raise StateError("has no body")
    version = document.get("schema_version")
    if type(version) is not int or version < SCHEMA_VERSION:
        raise StateError(f"is not of schema version {SCHEMA_VERSION}")
    try:
        expected = _encode(body, version)
    except (ValueError, RecursionError) as error:  # nesting that can be read may be too deep to write
        raise StateError("holds values that were never written") from error
    if expected == data:
        return body, version
    if version > SCHEMA_VERSION:
        raise _NewerError(
            f"is of a newer schema version than {SCHEMA_VERSION}, with a checksum that cannot be verified"
        )
    raise StateError("does not match its checksum")


def read_piece(path: Path, what: str, offset: int, length: int) -> bytes:
    """`length` bytes of a file from `offset`, fewer at its end. `what` names the file in error messages.

    Raises:
        NotFoundError: it cannot be read.
        UsageError: the offset lies beyond the end.
    """
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if offset > size:
                raise UsageError(f"`offset` lies beyond the end of the file ({size} bytes)")
            stream.seek(offset)
            return stream.read(length)
    except OSError as error:
        raise NotFoundError(f"{what} cannot be read: {error.strerror}") from error
