"""The thread that waits for the disk: what it has written, what it says of the disk, and that nobody waits with it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coec.errors import StateError
from coec.io import disk_writer as scribe_module
from coec.io.disk_writer import DiskWriter
from coec.io.storage import AppendLog
from support.disk import EVERY_OPERATION, Disk
from support.fake_worker import wait_until


class Book:
    """Writes when it is let, and refuses while it is told to."""

    def __init__(self) -> None:
        self.written = 0
        self.refuses = False
        self.let = threading.Event()
        self.let.set()

    def flush(self) -> None:
        assert self.let.wait(20.0)
        if self.refuses:
            raise StateError("cannot write the book: No space left on device")
        self.written += 1


@contextmanager
def writing(folder: Path) -> Iterator[DiskWriter]:
    writer_again = DiskWriter(folder)
    writer_again.thread.start()
    try:
        yield writer_again
    finally:
        writer_again.request_stop()
        assert writer_again.thread.join(20.0)
        assert writer_again.thread.failure is None


def test_what_is_put_down_is_written_soon_and_the_last_before_the_end(tmp_path: Path) -> None:
    book = Book()
    with writing(tmp_path) as writer_again:
        assert writer_again.has_written()
        writer_again.write(book)
        wait_until(writer_again.has_written, "the book")
        assert book.written == 1
        assert writer_again.problem is None
        writer_again.write(book)
    assert book.written == 2


def test_a_disk_that_refuses_is_named_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scribe_module, "RETRY_S", 0.01)
    broken, well = Book(), Book()
    broken.refuses = True
    with writing(tmp_path) as writer_again:
        writer_again.write(broken, well)
        wait_until(lambda: writer_again.problem is not None, "the trouble")
        assert writer_again.problem is not None
        assert (writer_again.problem.code, "No space" in writer_again.problem.text) == ("disk_failing", True)
        assert not writer_again.has_written()
        assert well.written == 1, "one book that cannot be written keeps no other waiting"
        broken.refuses = False
        wait_until(writer_again.has_written, "the second attempt")
        assert broken.written == 1
    assert writer_again.problem is None


def test_nobody_waits_for_a_disk_that_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scribe_module, "SLOW_S", 0.0)
    monkeypatch.setattr(scribe_module, "PATIENCE_S", 0.0)
    book = Book()
    book.let.clear()
    with writing(tmp_path) as writer_again:
        writer_again.write(book)
        wait_until(lambda: writer_again.problem is not None, "the trouble")
        assert writer_again.problem is not None
        assert writer_again.problem.code == "disk_slow"
        assert not writer_again.has_written()
        writer_again.write(book)
        book.let.set()
        wait_until(writer_again.has_written, "both")
    assert book.written == 2


@pytest.mark.parametrize(("code", "changed"), [("disk_full", {"f_bavail": 0}), ("disk_read_only", {"f_flag": 1})])
def test_a_disk_without_room_is_reported_before_anything_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, changed: dict[str, int]
) -> None:
    real = os.statvfs(tmp_path)
    names = [name for name in dir(real) if name.startswith("f_")]

    class ClosingResult:
        pass

    result = ClosingResult()
    for name in names:
        setattr(result, name, changed.get(name, getattr(real, name)))
    monkeypatch.setattr(os, "statvfs", lambda _: result)
    writer_again = DiskWriter(tmp_path)
    writer_again.check_folder()
    assert writer_again.problem is not None
    assert writer_again.problem.code == code
    monkeypatch.undo()
    writer_again.check_folder()
    assert writer_again.problem is None


# --- ledgers ----------------------------------------------------------------------------------------------------------


def ledger(path: Path, limit: int = 5) -> AppendLog[bytes]:
    made: AppendLog[bytes] = AppendLog(path, limit, lambda line: line)
    for line in made.load():
        made.restored(line)
    return made


def test_items_are_retained_at_once_and_on_the_disk_when_they_are_flushed(tmp_path: Path) -> None:
    retained = ledger(tmp_path / "l")
    for number in range(3):
        retained.add(lambda last, number=number: b"%d after %s" % (number, last or b"nothing"))  # type: ignore[misc]
    assert retained.items()[0] == b"0 after nothing"
    assert retained.items()[1].startswith(b"1 after 0 ")
    assert (retained.on_disk(), retained.durable, ledger(tmp_path / "l").items()) == ((), None, ())
    retained.flush()
    assert retained.on_disk() == retained.items() == ledger(tmp_path / "l").items()
    assert retained.durable == retained.items()[-1]


def test_what_is_added_while_the_disk_writes_comes_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever writes has begun when another item comes: also where the whole file is written anew."""
    retained = ledger(tmp_path / "l", limit=3)
    real = os.fsync
    number = 0

    def adding(descriptor: int) -> None:
        nonlocal number
        real(descriptor)
        number += 1
        retained.add(lambda _: b"%d" % number)

    monkeypatch.setattr(os, "fsync", adding)
    retained.add(lambda _: b"0")
    for _ in range(12):
        retained.flush()
    monkeypatch.undo()
    retained.flush()
    assert ledger(tmp_path / "l", limit=3).items() == retained.items() == retained.on_disk()
    lines = (tmp_path / "l").read_bytes().split()
    assert lines == sorted(set(lines), key=int)


def test_a_disk_that_refuses_for_long_does_not_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(tmp_path, monkeypatch)
    retained = ledger(tmp_path / "l", limit=5)
    disk.refuses = EVERY_OPERATION
    for number in range(100):
        retained.add(lambda _, number=number: b"%d" % number)  # type: ignore[misc]
        with pytest.raises(OSError, match="No space"):
            retained.flush()
    assert len(retained.items()) == 5
    disk.refuses = ()
    retained.flush()
    assert ledger(tmp_path / "l").items() == retained.items() == tuple(b"%d" % number for number in range(95, 100))


def test_a_hanging_disk_keeps_no_reader_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    retained = ledger(tmp_path / "l")
    hangs, let = threading.Event(), threading.Event()
    real = os.fsync

    def hanging(descriptor: int) -> None:
        hangs.set()
        assert let.wait(20.0)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", hanging)
    retained.add(lambda _: b"a")
    writer = threading.Thread(target=retained.flush)
    writer.start()
    assert hangs.wait(20.0)
    retained.add(lambda _: b"b")
    assert (retained.items(), retained.on_disk()) == ((b"a", b"b"), ())
    let.set()
    writer.join(20.0)
    assert retained.on_disk() == (b"a",)
