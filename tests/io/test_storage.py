"""Durable files: whole or not at all, whatever the disk refuses and whenever the power goes."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from coec.io import storage
from coec.io.storage import LineLog
from support.disk import EVERY_OPERATION, Disk


def log_of(path: Path, lines: list[bytes], limit: int = 100) -> LineLog:
    return LineLog(path, limit, lambda: lines[-limit:])


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "disk"
    folder.mkdir()
    return folder


# --- replacement ----------------------------------------------------------------------------------------------------


def test_a_file_is_replaced_whole_and_its_previous_copy_retained(root: Path) -> None:
    path, previous = root / "f", root / "f.previous"
    storage.replace(path, b"first", previous)
    storage.replace(path, b"second", previous)
    storage.replace(path, b"third", previous)
    assert (path.read_bytes(), previous.read_bytes()) == (b"third", b"second")
    assert names(root) == ["f", "f.previous"]


def test_at_every_refusal_the_file_is_old_or_new_and_nothing_else_is_left(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(root, monkeypatch)
    path, previous = root / "f", root / "f.previous"
    storage.replace(path, b"old old")
    before = disk.operations
    storage.replace(path, b"old old", previous)
    for refused in range(disk.operations - before):
        first = disk.operations
        disk.refuses = [first + refused]
        with suppress(OSError):
            storage.replace(path, b"new", previous)
        disk.refuses = ()
        assert path.read_bytes() in (b"old old", b"new")
        assert previous.read_bytes() == b"old old"
        storage.replace(path, b"old old")
        assert names(root) == ["f", "f.previous"]


def test_a_power_cut_in_a_replacement_leaves_the_one_or_the_other(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(root, monkeypatch)
    contents = (b"first", b"second, longer", b"3")
    for number, data in enumerate(contents):
        storage.replace(root / "f", data, root / "f.previous")
        disk.acknowledge(number)
    cuts = list(disk.power_cuts())
    assert len(cuts) > sum(map(len, contents))
    for cut in cuts:
        files = dict(cut.files)
        safe = len(cut.acknowledged)
        assert files.get("f") in (None, *contents)[safe : safe + 2]
        assert files.get("f.previous") in (None, *contents)


def test_folders_are_made_and_removed(root: Path) -> None:
    storage.make_folder(root / "a" / "b")
    storage.make_folder(root / "a" / "b")
    storage.replace(root / "a" / "b" / "f", b"1")
    storage.remove_folder(root / "a" / "b")
    storage.remove_folder(root / "a" / "b")
    storage.remove(root / "a" / "nothing")
    assert names(root / "a") == []
    (root / "file").write_bytes(b"")
    with pytest.raises(NotADirectoryError):
        storage.make_folder(root / "file")


# --- lines ----------------------------------------------------------------------------------------------------------


def write(log: LineLog, lines: list[bytes], line: bytes) -> None:
    lines.append(line)
    log.add(line)
    log.flush()


def test_a_torn_tail_is_left_out_and_cut_at_the_next_append(root: Path) -> None:
    path = root / "log"
    path.write_bytes(b"one\ntwo\nthr")
    lines = [b"one", b"two"]
    log = log_of(path, lines)
    assert log.load() == [b"one", b"two"]
    write(log, lines, b"3")
    assert path.read_bytes() == b"one\ntwo\n3\n"


def test_a_full_disk_leaves_no_half_line_and_what_waits_follows_in_order(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(root, monkeypatch)
    lines: list[bytes] = []
    log = log_of(root / "log", lines)
    write(log, lines, b"zero")
    disk.refuses = EVERY_OPERATION
    for line in (b"one", b"two"):
        with pytest.raises(OSError, match="No space"):
            write(log, lines, line)
        assert log.waiting
    assert log_of(root / "log", []).load() == [b"zero"]
    disk.refuses = ()
    log.flush()
    assert not log.waiting
    assert (root / "log").read_bytes() == b"zero\none\ntwo\n"


def test_a_file_that_has_become_too_long_is_written_anew(root: Path) -> None:
    lines: list[bytes] = []
    log = log_of(root / "log", lines, limit=3)
    for number in range(20):
        write(log, lines, b"%d" % number)
        result = log_of(root / "log", []).load()
        assert len(result) <= 6
        assert result[-3:] == lines[-3:]


@pytest.mark.parametrize("harm", [Path.unlink, lambda path: path.write_bytes(b"on")], ids=["removed", "cut"])
def test_what_somebody_else_took_is_written_again(root: Path, harm: Callable[[Path], object]) -> None:
    lines: list[bytes] = []
    log = log_of(root / "log", lines)
    write(log, lines, b"one")
    harm(root / "log")
    write(log, lines, b"two")
    assert (root / "log").read_bytes() == b"one\ntwo\n"


def test_what_somebody_else_took_is_written_again_though_the_disk_refuses_at_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for refused in range(8):
        root = tmp_path / str(refused)
        root.mkdir()
        with monkeypatch.context() as patch:
            disk = Disk(root, patch)
            lines: list[bytes] = []
            log = log_of(root / "log", lines)
            write(log, lines, b"one")
            write(log, lines, b"two")
            (root / "log").unlink()
            first = disk.operations + refused
            disk.refuses = [first]
            for line in (b"three", b"four"):
                with suppress(OSError):
                    write(log, lines, line)
            disk.refuses = ()
            log.flush()
            assert (root / "log").read_bytes() == b"one\ntwo\nthree\nfour\n"


@pytest.mark.fault("a power cut at any byte of a line that is appended", "no line that was acknowledged is lost")
def test_a_power_cut_takes_no_line_that_was_written(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(root, monkeypatch)
    lines: list[bytes] = []
    log = log_of(root / "log", lines, limit=3)
    for number in range(9):
        write(log, lines, b"%d" % number)
        disk.acknowledge(number)
    for cut in disk.power_cuts():
        whole = dict(cut.files).get("log", b"").rpartition(b"\n")[0].split()
        assert [int(line) for line in whole][-1:] >= list(cut.acknowledged)[-1:]


@pytest.mark.fault(
    "a disk that stays full for long", "memory stays bounded, and the newest is written when there is room"
)
def test_a_disk_that_stays_full_gets_the_newest_in_the_end(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(root, monkeypatch)
    disk.refuses = EVERY_OPERATION
    lines: list[bytes] = []
    log = log_of(root / "log", lines, limit=3)
    for number in range(100):
        with pytest.raises(OSError, match="No space"):
            write(log, lines, b"%d" % number)
    disk.refuses = ()
    log.flush()
    assert (root / "log").read_bytes() == b"97\n98\n99\n"


def test_a_file_that_cannot_be_read_is_written_anew(root: Path) -> None:
    (root / "log").mkdir()
    lines: list[bytes] = []
    log = log_of(root / "log", lines)
    with pytest.raises(OSError, match="directory"):
        log.load()
    (root / "log").rmdir()
    (root / "log").write_bytes(b"unknown")
    write(log, lines, b"one")
    assert (root / "log").read_bytes() == b"one\n"


@pytest.mark.fault("a disk that refuses calls in any order", "no line is lost, torn or out of order")
@pytest.mark.parametrize("length", [1, 2, 5, 40])
def test_whatever_is_refused_no_line_is_lost_torn_or_out_of_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int
) -> None:
    for first in range(60):
        root = tmp_path / f"{length}-{first}"
        root.mkdir()
        with monkeypatch.context() as patch:
            disk = Disk(root, patch)
            disk.refuses = range(first, first + length)
            lines: list[bytes] = []
            log = log_of(root / "log", lines, limit=3)
            safe = -1
            for number in range(10):
                with suppress(OSError):
                    write(log, lines, b"%d" % number)
                    safe = number
                result = [int(line) for line in log_of(root / "log", []).load()]
                assert result == list(range(result[0], result[-1] + 1)) if result else safe == -1
                assert not result or (result[-1] >= safe and result[0] <= max(0, result[-1] - 2))
            disk.refuses = ()
            log.flush()
            assert log_of(root / "log", []).load()[-1] == b"9"


# --- links ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """A file that somebody would like to have overwritten."""
    path = tmp_path / "other"
    path.write_bytes(b"not yours")
    return path


@pytest.mark.fault("a link under the name of a temporary file", "it is removed; the file behind it is not written")
@pytest.mark.parametrize("symbolic", [True, False], ids=["symbolic", "hard"])
@pytest.mark.parametrize("name", ["f.new", "f.link", "f"])
def test_a_replacement_writes_through_no_link(root: Path, other: Path, name: str, symbolic: bool) -> None:
    if name == "f.link" and not symbolic:
        return
    link = root / name
    link.symlink_to(other) if symbolic else link.hardlink_to(other)
    storage.replace(root / "f", b"mine", root / "f.previous")
    storage.replace(root / "f", b"mine too", root / "f.previous")
    assert other.read_bytes() == b"not yours"
    assert (root / "f").read_bytes() == b"mine too"
    assert not (root / "f").is_symlink()
    assert (root / "f.previous").read_bytes() == b"mine"
    assert names(root) == ["f", "f.previous"]


@pytest.mark.fault("a link in the place of a log", "the log is written again beside it; the file behind it is not")
@pytest.mark.parametrize("before", [True, False], ids=["before the start", "meanwhile"])
def test_a_log_writes_through_no_link(root: Path, other: Path, before: bool) -> None:
    lines: list[bytes] = []
    path = root / "log"
    log = log_of(path, lines)
    if before:
        path.symlink_to(other)
        assert log.load() == []
    else:
        write(log, lines, b"zero")
        path.unlink()
        path.symlink_to(other)
    write(log, lines, b"one")
    assert other.read_bytes() == b"not yours"
    assert not path.is_symlink()
    assert path.read_bytes() == b"".join(line + b"\n" for line in lines)


@pytest.mark.parametrize("harm", ["removed", "replaced"])
def test_a_log_that_somebody_else_removed_is_written_again_though_nothing_waits(root: Path, harm: str) -> None:
    lines: list[bytes] = []
    path = root / "log"
    log = log_of(path, lines)
    log.flush()
    assert not path.exists(), "nothing was ever written"
    write(log, lines, b"one")
    if harm == "replaced":
        (root / "copy").write_bytes(b"something else\n")
        (root / "copy").replace(path)
    else:
        path.unlink()
    log.flush()
    assert path.read_bytes() == b"one\n"


def test_a_part_is_gone_on_with_unless_it_is_a_link(root: Path, other: Path) -> None:
    path = root / "f.part"
    for data in (b"one ", b"two"):
        with os.fdopen(storage.reopen(path), "a+b") as stream:
            stream.write(data)
    assert path.read_bytes() == b"one two"
    for link in (path.symlink_to, path.hardlink_to):
        path.unlink()
        link(other)
        with os.fdopen(storage.reopen(path), "a+b") as stream:
            assert stream.tell() == 0
            stream.write(b"mine")
        assert (other.read_bytes(), path.read_bytes()) == (b"not yours", b"mine")


@pytest.mark.fault("a umask that hides nothing", "files of the service are closed to other users from the beginning")
def test_files_are_private_whatever_the_umask(root: Path) -> None:
    before = os.umask(0)
    try:
        storage.make_folder(root / "a" / "b")
        path = root / "a" / "b" / "f"
        storage.replace(path, b"1")
        log = log_of(root / "log", [b"one"])
        log.add(b"one")
        log.flush()
        os.close(storage.reopen(root / "part"))
        storage.replace(root / "told", b"1", mode=storage.BY_UMASK)
    finally:
        os.umask(before)
    files = (path, root / "log", root / "part", root / "told")
    assert [oct(path.stat().st_mode & 0o777) for path in files] == ["0o640"] * 3 + ["0o666"]
    assert [oct(path.stat().st_mode & 0o777) for path in (root / "a", root / "a" / "b")] == ["0o750"] * 2
