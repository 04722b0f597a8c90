"""Files that survive a full disk and a power cut, the one place that knows how: replacement, lines at an end, removal.

What a function here has done is on the disk when it returns: the data of a file by fsync of the file, its name by fsync
of the folder. Whatever the system refuses is raised as the `OSError` that it gave, and leaves the files as they were
or, where only the last fsync failed, as they were meant to be; never in between. Nothing here is safe from several
threads at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

FRESH_SUFFIX = ".new"
"""Of a file that is about to replace another; found at a start it is of no use, and the next replacement's own."""

_MODE = 0o666
"""Permissions of a new file, less what the umask of the process takes off: those that `open` gives."""

MAX_ASIDE = 8
"""Files of one name that are kept aside: those that came first tell most, and a disk that damages every file must not
be filled by them."""

_LINK_SUFFIX = ".link"
"""Of the second name of a file that is about to become the previous copy."""


def replace(path: Path, data: bytes, previous: Path | None = None) -> None:
    """Make `data` the whole content of a file, which is there as it was or as it shall be, at any moment.

    Args:
        path: the file; need not exist.
        previous: where what is replaced is kept, if there is something; None: nowhere.
    """
    fresh, link = _beside(path, FRESH_SUFFIX), _beside(path, _LINK_SUFFIX)
    try:
        _write_new(fresh, data)
        if previous is not None:
            link.unlink(missing_ok=True)
            with suppress(FileNotFoundError):
                link.hardlink_to(path)
                link.replace(previous)
        fresh.replace(path)
        sync_folder(path.parent)
    finally:  # nothing to remove after a success, but a rename onto another name of the same file leaves its own
        for leftover in (fresh, link):
            with suppress(OSError):
                leftover.unlink(missing_ok=True)


def publish(stream: BinaryIO, temporary: Path, final: Path) -> None:
    """Close a file that was written under a temporary name, and give it its own when it is on the disk."""
    stream.flush()
    os.fsync(stream.fileno())
    stream.close()
    temporary.replace(final)
    sync_folder(final.parent)


def keep_under(path: Path, other: Path) -> None:
    """Give a file a second name, which must be free."""
    other.hardlink_to(path)
    sync_folder(other.parent)


def set_aside(path: Path, suffix: str) -> None:
    """Give a file that is about to be replaced a second name beside it: its own and `suffix`, and -1, -2 and so on. One
    that is not there needs none. The first `MAX_ASIDE` are kept, and the newest of the later ones."""
    names = [_beside(path, suffix), *(_beside(path, f"{suffix}-{number}") for number in range(1, MAX_ASIDE + 1))]
    other = next((name for name in names if not name.exists()), names[-1])
    other.unlink(missing_ok=True)
    with suppress(FileNotFoundError):
        keep_under(path, other)


def remove(path: Path) -> None:
    """Remove a file; one that is not there is removed already."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def remove_folder(folder: Path) -> None:
    """Remove a folder of files; one that is not there is removed already."""
    with suppress(FileNotFoundError):
        for path in sorted(folder.iterdir()):
            path.unlink(missing_ok=True)
        folder.rmdir()
        sync_folder(folder.parent)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, as far as they are missing."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    with suppress(FileExistsError):
        folder.mkdir()
    sync_folder(folder)  # refuses what is there under this name and is no folder
    sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Log:
    """A file of lines that grows at its end, and is written anew when it has become too long.

    How many bytes of it are sound is known at any time: what stands behind them, left by a write that failed in this
    process or by the end of an earlier one, is cut off before anything is written behind it. Lines that could not be
    written wait, and go to the disk in order with the next.
    """

    def __init__(self, path: Path, limit: int, content: Callable[[], Iterable[bytes]]) -> None:
        """Nothing is read or written yet.

        Args:
            path: the file; its folder must exist.
            limit: lines; a file of twice as many is written anew.
            content: all lines that the file shall hold, from the memory of its owner, those that wait among them;
                asked for when the file is written anew.
        """
        self._path = path
        self._limit = limit
        self._content = content
        self._sound_bytes = 0
        self._lines = 0
        self._longest = 2 * limit
        self._waiting: list[bytes] = []
        self._anew = False
        self._named = False

    @property
    def waiting(self) -> bool:
        """Whether a line is not on the disk, or the file not what it shall be."""
        return bool(self._waiting) or self._anew

    def load(self) -> list[bytes]:
        """The whole lines of the file, without their ends; none when there is no file. A torn last one is left out.

        Raises:
            OSError: it is there, but cannot be read; it will be written anew.
        """
        self._anew = True
        try:
            data = self._path.read_bytes()
        except FileNotFoundError:
            data = b""
        self._anew = False
        self._sound_bytes = data.rfind(b"\n") + 1
        lines = data[: self._sound_bytes].split(b"\n")[:-1]
        self._lines = len(lines)
        return lines

    def renew(self) -> None:
        """The file is not what it shall be: the next `flush` writes it anew from `content`."""
        self._anew = True

    def add(self, line: bytes) -> None:
        """Add a line (without its end) to those that wait for `flush`."""
        self._waiting.append(line)
        if len(self._waiting) > self._limit:  # a disk that stays full must not fill the memory
            self._waiting.clear()
            self._anew = True

    def flush(self) -> None:
        """Write what waits.

        Raises:
            OSError: it could not be written; it waits for the next call.
        """
        if not self.waiting:
            return
        too_long = self._lines + len(self._waiting) > self._longest
        if self._anew or too_long or self._was_cut():
            self._rewrite()
            return
        data = _joined(self._waiting)
        self._write(data)
        self._sound_bytes += len(data)
        self._lines += len(self._waiting)
        self._waiting.clear()

    def _rewrite(self) -> None:
        self._anew = True  # whether the old or the new file is there is not known should the last fsync fail
        lines = list(self._content())
        data = _joined(lines)
        replace(self._path, data)
        self._anew = False
        self._waiting.clear()
        self._sound_bytes, self._lines = len(data), len(lines)
        self._longest = 2 * max(self._limit, len(lines))

    def _was_cut(self) -> bool:
        """Whether somebody else has cut or removed the file."""
        try:
            return self._path.stat().st_size < self._sound_bytes
        except FileNotFoundError:
            return self._sound_bytes > 0

    def _write(self, data: bytes) -> None:
        """Write behind what is sound, and cut what cannot be finished; if not even that is possible, the next does."""
        descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, _MODE)
        try:
            try:
                if os.fstat(descriptor).st_size > self._sound_bytes:
                    os.ftruncate(descriptor, self._sound_bytes)
                _write_at(descriptor, data, self._sound_bytes)
                os.fsync(descriptor)
            except OSError:
                with suppress(OSError):
                    os.ftruncate(descriptor, self._sound_bytes)
                raise
        finally:
            os.close(descriptor)
        if not self._named:  # by this process: whether an earlier one came so far is not known
            sync_folder(self._path.parent)
            self._named = True


def _write_new(path: Path, data: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, _MODE)
    try:
        _write_at(descriptor, data, 0)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_at(descriptor: int, data: bytes, at: int) -> None:
    """The system may take less than it is given; a full disk then refuses the rest."""
    view = memoryview(data)
    while view:
        count = os.pwrite(descriptor, view, at)
        view, at = view[count:], at + count


def _joined(lines: Iterable[bytes]) -> bytes:
    return b"".join(line + b"\n" for line in lines)


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)
