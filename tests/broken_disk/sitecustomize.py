"""Makes the disk below a folder full, read-only or slow while a file says so. Python imports this by itself where its
folder is on PYTHONPATH: in the service and in its worker, which know nothing of it.

`COEC_BROKEN_DISK` names the folder, `COEC_BROKEN_DISK_IS` the file: `well`, `full`, `read-only`, or `slow N` for N
bytes a second. What is not below the folder is left alone.
"""

from __future__ import annotations

import errno
import io
import os
import threading
import time
from typing import Any

ROOT = os.environ.get("COEC_BROKEN_DISK", "")
IS = os.environ.get("COEC_BROKEN_DISK_IS", "")
CHANGES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
FSYNC_BYTES = 4096
"""A journal entry: what the slow disk takes for a name or an fsync."""

_real: dict[str, Any] = {}
_opened: dict[int, bool] = {}
_arm = threading.Lock()
"""A disk does one thing after the other."""


def _state() -> str:
    try:
        descriptor = _real["open"](IS, os.O_RDONLY)
    except OSError:
        return "well"
    try:
        return bytes(os.read(descriptor, 100)).decode()
    finally:
        _real["close"](descriptor)


def _below(path: Any) -> bool:
    try:
        return str(os.path.abspath(os.fspath(path))).startswith(ROOT + os.sep)  # noqa: PTH100
    except TypeError:
        return False


def _refused(number: int) -> OSError:
    return OSError(number, os.strerror(number))


def _take(count: int, *, grows: bool, changes: bool = True) -> None:
    """The disk takes or gives so many bytes, or refuses."""
    state = _state()
    if changes and state == "read-only":
        raise _refused(errno.EROFS)
    if grows and state == "full":
        raise _refused(errno.ENOSPC)
    if state.startswith("slow "):
        with _arm:
            time.sleep(count / float(state.removeprefix("slow ")))


def _open(path: Any, flags: int, mode: int = 0o777, **rest: Any) -> int:
    below = not rest and _below(path)
    if below and flags & CHANGES:
        _take(FSYNC_BYTES, grows=False)
    descriptor: int = _real["open"](path, flags, mode, **rest)
    if below:
        _opened[descriptor] = True
    return descriptor


def _close(descriptor: int) -> None:
    _opened.pop(descriptor, None)
    _real["close"](descriptor)


def _pwrite(descriptor: int, data: Any, at: int) -> int:
    if descriptor in _opened:
        _take(len(data), grows=True)
    written: int = _real["pwrite"](descriptor, data, at)
    return written


def _syncing(name: str) -> Any:
    def sync(descriptor: int) -> None:
        if descriptor in _opened:
            _take(FSYNC_BYTES, grows=False, changes=False)
        _real[name](descriptor)

    return sync


def _naming(name: str) -> Any:
    def change(path: Any, *rest: Any, **options: Any) -> None:
        if not options and _below(path):
            _take(FSYNC_BYTES, grows=name == "mkdir")
        _real[name](path, *rest, **options)

    return change


def _statvfs(path: Any) -> os.statvfs_result:
    result: os.statvfs_result = _real["statvfs"](path)
    state = _state() if _below(os.path.join(path, "x")) else "well"  # noqa: PTH118
    if state == "full":
        return os.statvfs_result((*result[:4], 0, *result[5:]))
    if state == "read-only":
        return os.statvfs_result((*result[:8], result.f_flag | os.ST_RDONLY, *result[9:]))
    return result


class _File(io.FileIO):
    """Of the disk, when its name is below the folder, or it was opened there."""

    def __init__(self, path: Any, mode: str = "r", *rest: Any, **options: Any) -> None:
        opened = isinstance(path, int)
        self._below = path in _opened if opened else _below(path)
        if self._below and not opened and mode.strip("b") != "r":
            _take(FSYNC_BYTES, grows=False)
        super().__init__(path, mode, *rest, **options)
        if self._below:
            _opened[self.fileno()] = True

    def write(self, data: Any) -> int:
        if self._below:
            _take(memoryview(data).nbytes, grows=True)
        return super().write(data)

    def readinto(self, buffer: Any) -> int | None:
        count = super().readinto(buffer)
        if self._below and count:
            _take(count, grows=False, changes=False)
        return count

    def close(self) -> None:
        if not self.closed:
            _opened.pop(self.fileno(), None)
        super().close()


def _io_open(file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **options: Any) -> Any:
    if mode == "rb" and buffering == -1 and not rest and not options and _below(file):
        return io.BufferedReader(_File(file, "rb"))
    return _real["io.open"](file, mode, buffering, *rest, **options)


if ROOT and IS:
    for _name in ("open", "close", "pwrite", "fsync", "fdatasync", "statvfs"):
        _real[_name] = getattr(os, _name)
    os.open, os.close, os.pwrite, os.statvfs = _open, _close, _pwrite, _statvfs  # type: ignore[assignment]
    for _name in ("fsync", "fdatasync"):
        setattr(os, _name, _syncing(_name))
    for _name in ("unlink", "mkdir", "rmdir", "replace", "rename", "link"):
        _real[_name] = getattr(os, _name)
        setattr(os, _name, _naming(_name))
    _real["io.open"] = io.open
    io.open = _io_open
    io.FileIO = _File  # type: ignore[misc,assignment]
