"""The state directory, when somebody removes it under the running service; and who may read what is in it."""

from __future__ import annotations

import os
import shutil
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from coec.errors import ConfigError, UnavailableError
from coec.io.disk_writer import DiskWriter
from coec.io.rig_files import BASELINES, load_baseline, save_baseline
from coec.service.process_lifetime import locked
from coec.service.records.rig_store import RIG_FILE, RigBaseline
from support.estimates import a_baseline
from support.fake_worker import wait_until
from support.vehicles import BEGIN_S, DRIVE_END_S, PAIR_RIG, STEP_S, PairBench, pair_configuration


def books(folder: Path) -> dict[str, int]:
    """The files of a state directory but for the windows: path below it, and size."""
    result = (path for path in sorted(folder.rglob("*")) if path.is_file() and "windows" not in path.parts)
    return {str(path.relative_to(folder)): path.stat().st_size for path in result}


def remove(folder: Path, how: str) -> None:
    if how == "content":
        for path in folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return
    shutil.rmtree(folder)
    if how == "made again":
        folder.mkdir()


@pytest.mark.fault("`rm -rf` of the state directory under the running service", "the next write completes all books")
@pytest.mark.parametrize("how", ["made again", "content"])
def test_books_that_somebody_removed_are_written_again_from_memory(tmp_path: Path, how: str) -> None:
    bench = PairBench(tmp_path / "state")
    bench.drive(BEGIN_S, STEP_S + 60)
    before, entries = books(bench.folder), bench.store.history.entries()
    assert len(before) > 5
    remove(bench.folder, how)
    reported = bench.acknowledged("hold")
    assert (reported.code, reported.durable) == ("held", True)
    (bench.folder / "windows").mkdir()  # as the recorder does, which the bench has none of
    bench.drive(STEP_S + 60, STEP_S + 66)
    after = books(bench.folder)
    # The pictures of an event are in the files alone.
    pictures = {name for name in before if name.endswith(".jpg")}
    copies = {name for name in before if name.endswith(".previous")}
    assert set(before) - pictures - copies <= set(after)
    retained, served, hold = bench.store.history.entries(), bench.pose.copy(), bench.store.state.hold
    assert retained[: len(entries)] == entries
    rewritten = [entry.text for entry in bench.entries("chain")]
    if how == "made again":
        assert len(rewritten) == 1
        assert "recordings" in rewritten[0]
        assert "gone" in rewritten[0]
    bench.restart()
    assert bench.store.damage is None
    assert bench.store.history.damage is None
    assert [one.line for one in bench.store.history.entries()][: len(retained)] == [one.line for one in retained]
    assert bench.pose.tobytes() == served.tobytes()
    assert bench.store.state.hold == hold
    assert all(event.overlays == () for event in bench.store.incidents.events())


@pytest.mark.fault("the state directory is gone", "commands are acknowledged as not durable; `health` says why")
def test_without_a_state_directory_nothing_counts_as_written(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state")
    bench.drive(BEGIN_S, BEGIN_S + 20)
    remove(bench.folder, "gone")
    reported = bench.acknowledged("hold")
    assert (reported.code, reported.durable) == ("held", False)
    problem = bench.context.disk_writer.problem
    assert problem is not None
    assert problem.code == "disk_failing"
    bench.folder.mkdir()
    reported = bench.acknowledged("hold", release=True)
    assert (reported.code, reported.durable) == ("released", True)
    assert bench.context.disk_writer.problem is None
    bench.restart()
    assert [entry.code for entry in bench.entries("command")][-2:] == ["held", "released"]


def test_the_disk_writer_notices_by_itself_that_the_folder_is_another_one(tmp_path: Path) -> None:
    """Also when nobody notes anything; and once per time."""
    folder, reported = tmp_path / "state", list[str]()
    folder.mkdir()

    class Book:
        written = 0

        def flush(self) -> None:
            self.written += 1

    first, last = Book(), Book()
    disk_writer = DiskWriter(folder)
    disk_writer.register(last, first)
    disk_writer.register(last)
    disk_writer.on_replaced(reported.append)
    disk_writer.check_folder()
    disk_writer.write_due()
    assert (first.written, last.written, disk_writer.has_written()) == (0, 0, True)
    for time in (1, 2):
        remove(folder, "made again")
        disk_writer.check_folder()
        assert not disk_writer.has_written()
        disk_writer.write_due()
        assert (first.written, last.written, disk_writer.has_written(), len(reported)) == (time, time, True, time)
    assert list(disk_writer._registered) == [first, last]


def test_what_is_written_while_the_folder_is_replaced_is_written_again(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    folder.mkdir()

    class Book:
        def flush(self) -> None:
            (folder / "book").touch()
            if not list(tmp_path.glob("done")):
                (tmp_path / "done").touch()
                remove(folder, "made again")

    disk_writer = DiskWriter(folder)
    disk_writer.write(Book())
    disk_writer.write_due()
    assert not (folder / "book").exists()
    assert not disk_writer.has_written()
    disk_writer.write_due()
    assert (folder / "book").exists()
    assert disk_writer.has_written()


def test_a_thread_writes_them_again_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coec.io.disk_writer.RETRY_S", 0.01)
    folder, written = tmp_path / "state", threading.Event()
    folder.mkdir()

    class Book:
        def flush(self) -> None:
            written.set()

    disk_writer = DiskWriter(folder)
    disk_writer.register(Book())
    disk_writer.thread.start()
    try:
        remove(folder, "made again")
        wait_until(written.is_set, "the book")
    finally:
        disk_writer.request_stop()
        assert disk_writer.thread.join(20.0)


def test_a_baseline_that_somebody_removed_is_written_again(tmp_path: Path) -> None:
    config = pair_configuration(tmp_path)
    save_baseline(tmp_path / BASELINES, a_baseline())
    baseline = RigBaseline(config.pairs[0], PAIR_RIG, config.state)
    before = (tmp_path / BASELINES).read_bytes()
    (tmp_path / BASELINES).unlink()
    baseline.flush()
    assert (tmp_path / BASELINES).read_bytes() == before
    (tmp_path / BASELINES).write_bytes(b"damaged")
    baseline.flush()
    assert (tmp_path / BASELINES).read_bytes() == b"damaged", "it is left for people to look into"
    assert load_baseline(tmp_path / "none", "front") is None


# --- the lock ---------------------------------------------------------------------------------------------------------


@pytest.mark.fault("the state directory is made again under the running service", "a second daemon is still refused")
def test_the_lock_is_taken_again_in_a_directory_that_was_made_again(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    with locked(folder) as lock:
        with pytest.raises(UnavailableError, match="in use by another daemon"), locked(folder):
            pass
        remove(folder, "made again")
        lock.flush()
        lock.flush()
        with pytest.raises(UnavailableError, match="in use by another daemon"), locked(folder):
            pass
    with locked(folder):
        pass


def test_a_lock_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_bytes(b"kept")
    folder = tmp_path / "state"
    folder.mkdir()
    (folder / "lock").symlink_to(other)
    with pytest.raises(ConfigError, match="Too many levels of symbolic links"), locked(folder):
        pass
    assert other.read_bytes() == b"kept"


# --- who may read it --------------------------------------------------------------------------------------------------


@pytest.fixture
def no_umask() -> Iterator[None]:
    before = os.umask(0)
    try:
        yield
    finally:
        os.umask(before)


def open_to_others(folder: Path) -> list[str]:
    """Files and folders below one, and itself, that the group may write or others may read."""
    places = [folder, *folder.rglob("*")]
    return sorted(str(path) for path in places if stat.S_IMODE(path.lstat().st_mode) & 0o027)


@pytest.mark.fault("a umask that hides nothing", "other users of the machine can read nothing of the state")
@pytest.mark.usefixtures("no_umask")
def test_no_book_is_open_to_other_users(tmp_path: Path) -> None:
    with locked(tmp_path / "state"):
        bench = PairBench(tmp_path / "state")
        save_baseline(bench.folder / BASELINES, a_baseline())
        bench.drive(BEGIN_S, DRIVE_END_S)
        result = books(bench.folder)
        assert {"lock", "state.json", "state.json.previous", BASELINES, "history-front.jsonl"} <= set(result)
        assert any(name.startswith("evidence/") for name in result)
        # The recorder of this bench makes empty files for windows, by itself.
        shutil.rmtree(bench.folder / "windows")
        assert open_to_others(bench.folder) == []


def test_what_an_earlier_version_left_open_is_closed_at_the_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, other = tmp_path / "state", tmp_path / "other"
    other.write_bytes(b"")
    other.chmod(0o666)
    for name in ("", "windows", "evidence", "evidence/front-1", "snippets", "mine"):
        (folder / name).mkdir()
        (folder / name).chmod(0o777)
    files = ["state.json", RIG_FILE, "windows/front-1.mcap", "evidence/front-1/event.json", "mine/notes"]
    for name in files:
        (folder / name).write_bytes(b"")
        (folder / name).chmod(0o666)
    (folder / "windows" / "link.mcap").symlink_to(other)
    with locked(folder):
        assert stat.S_IMODE((folder / "state.json").stat().st_mode) == 0o640
        assert stat.S_IMODE((folder / "windows").stat().st_mode) == 0o750
        links = str(folder / "windows" / "link.mcap")
        assert set(open_to_others(folder)) - {links} == {str(folder / "mine"), str(folder / "mine" / "notes")}
        assert stat.S_IMODE(other.stat().st_mode) == 0o666, "a link is not followed"
    assert "9 files and folders" in caplog.text
    caplog.clear()
    with locked(folder):
        pass
    assert caplog.text == ""
