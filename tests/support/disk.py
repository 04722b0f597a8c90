"""A disk that fails when it is told to, and that remembers what was done to it: what a power cut would leave.

It stands between `os` and a folder. What reaches the platter, and what does not, is modelled as strictly as POSIX
allows: the data of a file are safe after fsync of the file, a name after fsync of its folder, and of what is not safe
any beginning may have been written.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

EVERY_OPERATION = range(sys.maxsize)
"""For `Disk.refuses`."""


@dataclass(frozen=True)
class PowerCut:
    """What a restart finds: files by their path, folders, and what had been acknowledged when the power went."""

    files: tuple[tuple[str, bytes], ...]
    folders: tuple[str, ...]
    acknowledged: tuple[int, ...]

    def restore(self, folder: Path) -> Path:
        """Lay it out in a new folder."""
        folder.mkdir()
        for name in self.folders:
            (folder / name).mkdir()
        for name, data in self.files:
            (folder / name).write_bytes(data)
        return folder


@dataclass
class _File:
    safe: bytes = b""
    now: bytes = b""


@dataclass
class _Names:
    """Files by path, and folders."""

    files: dict[str, int] = field(default_factory=dict)
    folders: set[str] = field(default_factory=set)

    def copy(self) -> _Names:
        return _Names(dict(self.files), set(self.folders))

    def change(self, what: str, path: str, to: Any) -> None:
        match what:
            case "create":
                self.files[path] = to
            case "replace":
                # A rename onto another name of the same file does nothing.
                if self.files.get(to) != self.files[path]:
                    self.files[to] = self.files.pop(path)
            case "link":
                self.files[to] = self.files[path]
            case "unlink":
                del self.files[path]
            case "mkdir":
                self.folders.add(path)
            case "rmdir":
                self.folders.discard(path)


class Disk:
    """The folder `root`, empty at the start, as `os` sees it while `monkeypatch` lasts.

    Attributes:
        operations: how many there were that change something.
        refuses: numbers of the operations that the disk refuses.
    """

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root = root
        self.operations = 0
        self.refuses: Container[int] = ()
        self._journal: list[tuple[Any, ...]] = []
        self._opened: dict[int, str] = {}
        self._ids: dict[str, int] = {}
        self._made = 0
        self._half_written = False
        self._real = {name: getattr(os, name) for name in ("open", "close", "pwrite", "fsync", "ftruncate")}
        for name in self._real:
            monkeypatch.setattr(os, name, getattr(self, f"_{name}"))
        for name in ("unlink", "mkdir", "rmdir", "replace", "link"):
            self._real[name] = getattr(os, name)
            monkeypatch.setattr(os, name, self._naming(name))

    def acknowledge(self, number: int) -> None:
        """Something is safe, as the code under test says."""
        self._journal.append(("acknowledge", number))

    def power_cuts(self) -> Iterator[PowerCut]:
        """Everything that a power cut at any moment may have left, each once: at every byte of every write."""
        seen: set[PowerCut] = set()
        for cut in self._cuts():
            if cut not in seen:
                seen.add(cut)
                yield cut

    # --- what `os` is replaced by ---------------------------------------------------------------------------------

    def _refuse(self) -> None:
        self.operations += 1
        if self.operations - 1 in self.refuses:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _name(self, path: Any) -> str | None:
        path = Path(os.fspath(path))
        return str(path.relative_to(self.root)) if path.is_relative_to(self.root) else None

    def _open(self, path: Any, flags: int, mode: int = 0o777, **rest: Any) -> int:
        name = None if rest else self._name(path)
        writes = name is not None and bool(flags & os.O_WRONLY)
        if writes:
            self._refuse()
        descriptor: int = self._real["open"](path, flags, mode, **rest)
        if name is None:
            return descriptor
        self._opened[descriptor] = name
        if writes and name not in self._ids:
            self._made += 1
            self._ids[name] = self._made
            self._journal.append(("create", name, self._made))
        if writes and flags & os.O_TRUNC:
            self._journal.append(("truncate", self._ids[name], 0))
        return descriptor

    def _close(self, descriptor: int) -> None:
        self._opened.pop(descriptor, None)
        self._real["close"](descriptor)

    def _pwrite(self, descriptor: int, data: Any, at: int) -> int:
        name = self._opened.get(descriptor)
        if name is not None:
            if self.operations in self.refuses and not self._half_written and len(data) > 1:
                data, self._half_written = data[: len(data) // 2], True  # as much as fits; the rest is refused
            else:
                self._half_written = False
                self._refuse()
            self._journal.append(("write", self._ids[name], at, bytes(data)))
        written: int = self._real["pwrite"](descriptor, data, at)
        return written

    def _fsync(self, descriptor: int) -> None:
        name = self._opened.get(descriptor)
        if name is not None:
            self._refuse()
        if name is None:
            self._real["fsync"](descriptor)
        else:  # the model is the platter
            self._journal.append(("fsync", self._ids[name]) if name in self._ids else ("sync", name))

    def _ftruncate(self, descriptor: int, size: int) -> None:
        name = self._opened.get(descriptor)
        if name is not None:
            self._refuse()
            self._journal.append(("truncate", self._ids[name], size))
        self._real["ftruncate"](descriptor, size)

    def _naming(self, what: str) -> Callable[..., None]:
        def changed(path: Any, *rest: Any, **options: Any) -> None:
            name = None if options.get("dir_fd") is not None else self._name(path)
            if name is not None:
                self._refuse()
            self._real[what](path, *rest, **options)
            if name is None:
                return
            to = self._name(rest[0]) if what in ("replace", "link") else None
            self._journal.append((what, name, to))
            names = _Names(self._ids)
            names.change(what, name, to)

        return changed

    # --- what is left ---------------------------------------------------------------------------------------------

    def _cuts(self) -> Iterator[PowerCut]:
        files: dict[int, _File] = {}
        safe, pending = _Names(), list[tuple[str, str, Any]]()
        acknowledged: tuple[int, ...] = ()
        for what, *rest in self._journal:
            match what, rest:
                case "acknowledge", [number]:
                    acknowledged = (*acknowledged, number)
                case "write", [file, at, data]:
                    before = files[file].now
                    for count in range(len(data)):
                        files[file].now = before[:at] + data[:count] + before[at + count :]
                        yield from _states(files, safe, pending, acknowledged, ("now",))
                    files[file].now = before[:at] + data + before[at + len(data) :]
                case "truncate", [file, size]:
                    files[file].now = files[file].now[:size]
                case "fsync", [file]:
                    files[file].safe = files[file].now
                case "sync", [folder]:
                    for change in pending:
                        if str(Path(change[1]).parent) == folder:
                            safe.change(*change)
                    pending = [change for change in pending if str(Path(change[1]).parent) != folder]
                case _:
                    pending.append((what, rest[0], rest[1]))
                    if what == "create":
                        files[rest[1]] = _File()
            yield from _states(files, safe, pending, acknowledged, ("now", "safe"))


def _states(
    files: dict[int, _File],
    safe: _Names,
    pending: list[tuple[str, str, Any]],
    acknowledged: tuple[int, ...],
    versions: tuple[str, ...],
) -> Iterator[PowerCut]:
    names = safe.copy()
    for change in (None, *pending):
        if change is not None:
            names.change(*change)
        folders = tuple(sorted(names.folders))
        for version in versions:
            content = {path: getattr(files[file], version) for path, file in names.files.items()}
            inside = {path: data for path, data in content.items() if str(Path(path).parent) in (".", *folders)}
            yield PowerCut(tuple(sorted(inside.items())), folders, acknowledged)


class FullDisk:
    """The disk below `root`, also for files that are written through streams, while `monkeypatch` lasts: each write,
    fsync, name and the like is counted, and refused where it is told to. It models no power cut.

    Attributes:
        operations: how many there were.
        refuses: numbers of those that it refuses.
    """

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch, error: int = errno.ENOSPC) -> None:
        self.operations = 0
        self.refuses: Container[int] = ()
        self._root = root
        self._error = error
        self._opened: set[int] = set()
        disk = self

        class File(io.FileIO):
            def __init__(self, path: Any, mode: str = "r") -> None:
                self._below = path in disk._opened if isinstance(path, int) else disk._is_below(path)
                if self._below and mode != "rb" and not isinstance(path, int):
                    disk._count()
                super().__init__(path, mode)
                if self._below:
                    disk._opened.add(self.fileno())

            def write(self, data: Any) -> int:
                if self._below:
                    disk._count()
                return super().write(data)

            def close(self) -> None:
                if not self.closed:
                    disk._opened.discard(self.fileno())
                super().close()

        monkeypatch.setattr(io, "FileIO", File)
        for name in ("fsync", "fdatasync", "pwrite"):
            monkeypatch.setattr(os, name, self._of_file(getattr(os, name)))
        for name in ("unlink", "mkdir", "replace", "link", "open"):
            monkeypatch.setattr(os, name, self._of_name(getattr(os, name)))

    def _count(self) -> None:
        self.operations += 1
        if self.operations - 1 in self.refuses:
            raise OSError(self._error, os.strerror(self._error))

    def _is_below(self, path: Any) -> bool:
        return Path(os.fspath(path)).is_relative_to(self._root)

    def _of_file(self, real: Callable[..., Any]) -> Callable[..., Any]:
        def changed(descriptor: int, *rest: Any) -> Any:
            if descriptor in self._opened:
                self._count()
            return real(descriptor, *rest)

        return changed

    def _of_name(self, real: Callable[..., Any]) -> Callable[..., Any]:
        def changed(path: Any, *rest: Any, **options: Any) -> Any:
            below = options.get("dir_fd") is None and self._is_below(path)
            reads = real.__name__ == "open" and not rest[0] & (os.O_WRONLY | os.O_RDWR)
            if below and not reads:
                self._count()
            result = real(path, *rest, **options)
            if below and real.__name__ == "open":
                self._opened.add(result)
            return result

        return changed
