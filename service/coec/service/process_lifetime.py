"""The lifetime of the service's process: the signals that stop it or have it read its configuration again, the lock of
its state directory, and the steps of an orderly end. The directory is locked, so that only one daemon uses it, and
closed to other users of the machine. Each step of the end is tried, and none waits longer than its time limit.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import signal
import stat
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from coec.errors import ConfigError, StateError, UnavailableError, permission_denied
from coec.io import storage
from coec.io.system import ServiceThread

_log = logging.getLogger(__name__)

LOCK = "lock"

NO_DIRECTORY = frozenset({errno.ENOTDIR, errno.EEXIST, errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL, errno.EISDIR})
"""Errors that say that a path cannot be that of a state directory, whatever the disk does later."""

FORBIDDEN = 0o777 & ~storage.PRIVATE_FOLDER
"""Permissions that nothing in the state directory may have: writing for the group, anything for other users."""

OWN_FOLDERS = ("windows", "snippets", "evidence")
"""Folders of the service in the state directory; other ones in it are left alone."""


@contextmanager
def locked(folder: Path) -> Iterator[FolderLock]:
    """Makes the state directory if it does not exist, locks it against other daemons within the block, and takes from
    its files what other users of the machine may do with them.

    Raises:
        ConfigError: this user may not make or write the directory, or its path cannot be that of a directory.
        UnavailableError: the disk refuses it (full, read-only, failing), or another daemon uses it.
    """
    try:
        storage.make_folder(folder)
        lock = FolderLock(folder)
    except OSError as error:
        what = f"state.directory {folder} cannot be made or written"
        if isinstance(error, PermissionError):
            existing = next(place for place in (folder, *folder.parents) if os.path.exists(place))  # noqa: PTH110
            raise ConfigError(f"{what}: {permission_denied(existing, 'rwx')}") from error
        if error.errno in NO_DIRECTORY:
            raise ConfigError(f"{what}: {error.strerror}; name another directory") from error
        raise UnavailableError(f"{what}: {error.strerror}; check its disk") from error
    try:
        tightened = close_to_others(folder)
        if tightened:
            text = f"{tightened} files and folders of {folder} were open to other users: these permissions were removed"
            _log.warning(text)
        yield lock
    finally:
        lock.release()


class FolderLock:
    """The lock of a state directory. It is `Persistable` too: if somebody has removed the directory and
    made it again, the lock is taken again with the rest."""

    def __init__(self, folder: Path) -> None:
        """Takes the lock.

        Raises:
            OSError: the lock file cannot be made.
            UnavailableError: another daemon has the lock.
        """
        self._path = folder / LOCK
        self._descriptor = self._taken()

    def flush(self) -> None:
        """Takes the lock again if its file is not in the directory any more.

        Raises:
            StateError: the lock file cannot be made, or another daemon has the lock.
        """
        with suppress(FileNotFoundError):
            if os.path.samestat(self._path.lstat(), os.fstat(self._descriptor)):
                return
        try:
            descriptor = self._taken()
        except OSError as error:
            raise StateError(f"cannot write {self._path}: {error.strerror}") from error
        except UnavailableError as error:
            raise StateError(str(error)) from error
        self.release()
        self._descriptor = descriptor

    def release(self) -> None:
        """Gives the lock up."""
        os.close(self._descriptor)

    def _taken(self) -> int:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(self._path, flags, storage.PRIVATE)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            raise UnavailableError(f"state.directory {self._path.parent} is in use by another daemon") from error
        return descriptor


def close_to_others(folder: Path) -> int:
    """Takes the permissions `FORBIDDEN` from the state directory and what the service keeps in it, as an earlier
    version of the service may have left them. Returns how many files and folders had some. Links, and what belongs to
    another user, stay as they are."""
    below = [folder / name for name in OWN_FOLDERS]
    events = [path for path in _entries(folder / "evidence") if path.is_dir()]
    places = [folder, *below]
    for place in (folder, *below, *events):
        places += [path for path in _entries(place) if place is not folder or not path.is_dir()]
    return sum(_is_tightened(path) for path in places)


def _entries(folder: Path) -> list[Path]:
    with suppress(OSError):
        return [] if folder.is_symlink() else sorted(folder.iterdir())
    return []


def _is_tightened(path: Path) -> bool:
    """Whether a file or folder had permissions to take, and they were taken."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            status = os.fstat(descriptor)
            mode = status.st_mode
            own = status.st_uid == os.geteuid() and (stat.S_ISREG(mode) or stat.S_ISDIR(mode))
            if own and mode & FORBIDDEN:
                os.fchmod(descriptor, stat.S_IMODE(mode) & ~FORBIDDEN)
                return True
        finally:
            os.close(descriptor)
    return False


class Signals:
    """Which signals have come: SIGHUP sets `reread`, every other one `stop`."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self.reread = threading.Event()

    def receive(self, number: int, _frame: FrameType | None) -> None:
        """The signal handler."""
        (self.reread if number == signal.SIGHUP else self.stop).set()


@contextmanager
def handled_signals() -> Iterator[Signals]:
    """Handles the signals of the process within the block, and restores the earlier handlers after it."""
    signals = Signals()
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = {number: signal.signal(number, signals.receive) for number in numbers}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def attempt(name: str, step: Callable[[], object]) -> object:
    """Runs one step of the end and returns its result. If it raises, the exception is logged, and the result is
    None."""
    try:
        return step()
    except Exception:
        _log.exception("a step of the shutdown failed", extra={"fields": {"step": name}})
        return None


def stopped(threads: Sequence[ServiceThread], timeout_s: float) -> bool:
    for thread in threads:
        thread.request_stop()
    return joined(threads, timeout_s)


def joined(threads: Sequence[ServiceThread], timeout_s: float) -> bool:
    """Waits for threads that were asked to stop. If one does not stop within the time, logs that and returns False."""
    deadline_s = time.monotonic() + timeout_s
    late = [thread.name for thread in threads if not thread.join(max(deadline_s - time.monotonic(), 0.0))]
    if late:
        _log.error("threads did not stop in time", extra={"fields": {"threads": late}})
    return not late
