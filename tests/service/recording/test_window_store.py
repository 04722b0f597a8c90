"""The store of windows: what goes and what stays whatever the clocks say, and a list that costs no reading."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from coec.config import StateConfig
from coec.errors import NotFoundError, RecordingError, UsageError
from coec.io.mcap.windows import RecordedWindow
from coec.service.recording import window_store
from coec.service.recording.window_store import EXPIRED_AT_ONCE, WindowStore, WindowVersion
from support.disk import EVERY_OPERATION, Disk

DEADLINE_S = 20.0
DAY_NS = 86_400 * 10**9
START_NS = 1_700_000_000 * 10**9


def store_of(path: Path, **limits: Any) -> WindowStore:
    return WindowStore(path / "windows", StateConfig(**{"min_free_bytes": 0, "max_age_days": 90.0, **limits}))


def write(store: WindowStore, name: str, data: bytes = b"window", age_days: float = 0.0) -> Path:
    """A file that is there, as an earlier run left it."""
    path = store.path(name)
    path.write_bytes(data)
    modified_ns = time.time_ns() - round(age_days * DAY_NS)
    os.utime(path, ns=(modified_ns, modified_ns))
    return path


def version_of(path: Path, **known: Any) -> WindowVersion:
    status = path.stat()
    values = {"pairs": 3, "decision": None, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), **known}
    return WindowVersion(size_bytes=status.st_size, modified_ns=status.st_mtime_ns, **values)


def record(store: WindowStore, name: str, data: bytes = b"window", age_days: float = 0.0) -> Path:
    """A file that the recorder has just written."""
    path = write(store, name, data, age_days)
    known = version_of(path)
    store.add(RecordedWindow(path, name, 3, known.size_bytes, known.modified_ns, known.sha256))
    return path


def at(day: float, pair: str = "front") -> str:
    """Id of a window that began so many days after the first."""
    return f"{pair}-{START_NS + round(day * DAY_NS)}"


def make_room(store: WindowStore) -> None:
    store.make_room(lambda: None)


def stems(store: WindowStore, pair: str = "front") -> list[str]:
    return [path.stem for path in store.windows(pair)]


# --- age ------------------------------------------------------------------------------------------------------------


def test_a_window_is_too_old_when_wall_clock_and_sensor_time_say_so(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    record(store, at(0), age_days=100)
    record(store, at(50), age_days=50)
    record(store, at(100))
    make_room(store)
    assert stems(store) == [at(50), at(100)]
    assert store.removed == 1


def jumped(monkeypatch: pytest.MonkeyPatch, days: float) -> None:
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + round(days * DAY_NS))


@pytest.mark.fault("a wall clock that jumps by years", "no window is removed")
@pytest.mark.parametrize("days", [100, -400, 10_000])
def test_a_wall_clock_that_jumps_takes_no_window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: int) -> None:
    store = store_of(tmp_path)
    for hour in range(8):
        record(store, at(hour / 24))
    with monkeypatch.context() as patch:
        jumped(patch, days)
        record(store, at(9 / 24), age_days=-days)
        make_room(store)
    make_room(store)
    assert len(stems(store)) == 9


@pytest.mark.fault("a sensor clock that jumps by years", "no window is removed")
@pytest.mark.parametrize("days", [100, -100])
def test_a_sensor_clock_that_jumps_takes_no_window(tmp_path: Path, days: int) -> None:
    store = store_of(tmp_path)
    for hour in range(8):
        record(store, at(hour / 24))
    record(store, at(days))
    make_room(store)
    assert len(stems(store)) == 9


@pytest.mark.fault("wall and sensor clock that jump together", "at most two windows go at a time")
def test_clocks_that_jump_together_take_few_at_a_time(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    for hour in range(8):
        record(store, at(hour / 24), age_days=100)
    record(store, at(100))
    make_room(store)
    assert len(stems(store)) == 9 - EXPIRED_AT_ONCE
    assert stems(store)[0] == at(EXPIRED_AT_ONCE / 24)


def test_the_sensor_clock_of_another_pair_says_nothing(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    record(store, at(0), age_days=100)
    record(store, at(1), age_days=100)
    record(store, at(500, "rear"))
    make_room(store)
    assert stems(store) == [at(0), at(1)]


def test_files_from_the_future_are_not_too_old_and_not_the_latest(tmp_path: Path) -> None:
    store = store_of(tmp_path, max_bytes=2**20)
    record(store, at(0), bytes(400_000), age_days=-1000)
    record(store, at(1), bytes(400_000))
    record(store, at(2), bytes(400_000))
    make_room(store)
    assert stems(store) == [at(2)], "the first recorded go first, whatever their time says"


# --- room -----------------------------------------------------------------------------------------------------------


def test_room_is_made_by_bytes_oldest_first(tmp_path: Path) -> None:
    store = store_of(tmp_path, max_bytes=2**20)
    for day in range(3):
        record(store, at(day), bytes(400_000))
    make_room(store)  # another 400 kB would not fit beside two
    assert stems(store) == [at(2)]
    assert store.removed == 2


def test_the_latest_of_every_pair_and_what_is_held_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = store_of(tmp_path, min_free_bytes=1000)
    monkeypatch.setattr(window_store, "_free_bytes", lambda _: 999)
    for day in range(4):
        record(store, at(day))
        record(store, at(day, "rear"))
    for _ in range(2):
        store.hold(at(1))
    with pytest.raises(RecordingError, match="min_free_bytes"):
        make_room(store)
    assert (stems(store), stems(store, "rear")) == ([at(1), at(3)], [at(3, "rear")])
    store.release(at(1))
    with pytest.raises(RecordingError):
        make_room(store)
    assert stems(store) == [at(1), at(3)], "it was held twice"
    store.release(at(1))
    with pytest.raises(RecordingError):
        make_room(store)
    assert stems(store) == [at(3)]


def test_evidence_is_the_last_to_go_and_never_for_its_age(tmp_path: Path) -> None:
    store = store_of(tmp_path, max_bytes=2**20)
    record(store, at(0), bytes(100_000), age_days=200)
    record(store, at(1), bytes(100_000), age_days=200)
    record(store, at(200), bytes(100_000))
    store.protect("front", {at(0): "red_event"})
    make_room(store)
    assert stems(store) == [at(0), at(200)]
    record(store, at(201), bytes(450_000))
    make_room(store)
    assert stems(store) == [at(0), at(201)]
    record(store, at(202), bytes(550_000))
    make_room(store)
    assert stems(store) == [at(202)]


def test_what_is_retained_is_reported_and_bounded_the_oldest_first(tmp_path: Path) -> None:
    store = store_of(tmp_path, max_bytes=2**20, max_protected_bytes=250_000)
    for day in range(4):
        record(store, at(day), bytes(100_000), age_days=400 - day)
    record(store, at(400), bytes(100_000))

    def retained_for() -> list[str | None]:
        return [info.kept_for for info in store.listing("front")]

    store.protect("front", {at(0): "commissioning", at(1): "commissioning", at(2): "red_event"})
    assert retained_for() == [None, "commissioning", "red_event", None, None]
    store.note(at(2), version_of(store.path(at(2)), decision="failed"))
    assert retained_for() == [None, "commissioning", "red_event", None, None]
    make_room(store)
    assert stems(store) == [at(1), at(2), at(400)], "what is kept beyond the bound goes for its age like any other"
    store.reconfigure(StateConfig(max_protected_bytes=0, min_free_bytes=0))
    assert retained_for() == [None, None, None]


def test_progress_is_reported_with_every_window_that_goes(tmp_path: Path) -> None:
    store = store_of(tmp_path, max_bytes=2**20)
    for day in range(9):
        record(store, at(day), bytes(400_000))
    reported: list[int] = []
    store.make_room(lambda: reported.append(1))
    assert len(reported) == store.removed == 8


@pytest.mark.fault("somebody removes the folder of windows", "it is made again")
def test_a_folder_that_somebody_removed_is_made_again(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    record(store, at(0)).unlink()
    (tmp_path / "windows").rmdir()
    store.scan()
    assert store.usage().used == 0
    assert store.listing("front") == ()
    make_room(store)
    record(store, at(1))
    assert stems(store) == [at(1)]


# --- what is there --------------------------------------------------------------------------------------------------


def test_pairs_whose_names_begin_alike_do_not_mix_and_other_files_are_left_alone(tmp_path: Path) -> None:
    store = store_of(tmp_path, max_bytes=2**20)
    write(store, "front-1")
    write(store, "front-left-2")
    notes = write(store, "notes", bytes(2**21))
    make_room(store)
    assert stems(store) == ["front-1"]
    assert stems(store, "front-left") == ["front-left-2"]
    assert notes.exists()
    assert store.usage().used == 2 * len(b"window")


@pytest.mark.fault("names of windows that lead out of the folder", "no other file is read")
@pytest.mark.parametrize("window_id", ["../state", "front-1/..", "rear-1", "front-2", "front-1\0", "front-x", ""])
def test_only_the_pairs_own_windows_are_read(tmp_path: Path, window_id: str) -> None:
    store = store_of(tmp_path)
    write(store, "front-1", bytes(5))
    write(store, "rear-1", bytes(5))
    assert store.read("front", "front-1", 3, 100) == bytes(2)
    with pytest.raises(NotFoundError):
        store.read("front", window_id, 0, 1)
    with pytest.raises(UsageError, match="offset"):
        store.read("front", "front-1", 6, 1)


def test_the_order_of_recording_survives_a_restart_and_any_time(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    record(store, at(5), age_days=1)
    record(store, at(9), age_days=-30)
    record(store, at(2), age_days=7)
    assert stems(store) == stems(store_of(tmp_path)) == [at(5), at(9), at(2)]
    record(store, at(5))  # a recording that is played again
    assert stems(store) == stems(store_of(tmp_path)) == [at(9), at(2), at(5)]


def test_files_that_nobody_reported_are_ordered_by_their_times(tmp_path: Path) -> None:
    (tmp_path / "windows").mkdir()
    for day in (3, 1, 2):
        path = tmp_path / "windows" / f"{at(day)}.mcap"
        path.write_bytes(b"window")
        os.utime(path, ns=(START_NS + day, START_NS + day))
    assert stems(store_of(tmp_path)) == [at(1), at(2), at(3)]


# --- the list -------------------------------------------------------------------------------------------------------


def test_a_restart_lists_what_was_known_without_opening_a_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_of(tmp_path)
    for day in range(3):
        record(store, at(day), b"window %d" % day)
    store.note(at(1), version_of(store.path(at(1)), decision="accepted"))
    store.flush()

    real = Path.open

    def opened(path: Path, *rest: Any, **options: Any) -> Any:
        assert path.suffix != ".mcap", "a window was opened"
        return real(path, *rest, **options)

    monkeypatch.setattr(Path, "open", opened)
    before, after = store.listing("front"), store_of(tmp_path).listing("front")
    assert before == after
    assert [(info.pairs, info.decision) for info in after] == [(3, None), (3, "accepted"), (3, None)]
    assert after[2].sha256 == hashlib.sha256(b"window 2").hexdigest()
    assert store.unread("front") == ()


def test_a_window_that_was_written_again_has_no_digest_until_it_is_noted(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    path = record(store, at(0))
    first = version_of(path)
    with_result = path.with_suffix(".tmp")
    with_result.write_bytes(b"window with result")
    with_result.replace(path)
    store.scan()
    (info,) = store.listing("front")
    assert (info.sha256, info.size_bytes, info.pairs) == (None, 18, 3)
    assert store.unread("front") == (path.stem,)
    store.note(at(0), first)  # what was read before it was written again does not count
    assert store.listing("front")[0].sha256 is None
    store.note(at(0), version_of(path, decision="failed"))
    (info,) = store.listing("front")
    assert (info.sha256, info.decision) == (hashlib.sha256(b"window with result").hexdigest(), "failed")
    assert store.version(at(0)) == version_of(path, decision="failed")
    assert store.version(at(1)) is None


def test_what_is_gone_is_forgotten_and_the_index_stays_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coec.service.recording.window_store.INDEX_LINES", 10)
    store = store_of(tmp_path)
    for day in range(60):
        record(store, at(day))
        if day >= 3:
            store.path(at(day - 3)).unlink()
        assert len(store.listing("front")) <= 4
    assert len((tmp_path / "windows.jsonl").read_bytes().splitlines()) <= 20
    assert stems(store_of(tmp_path)) == [at(day) for day in (57, 58, 59)]


@pytest.mark.fault("a damaged index of the windows", "the windows are read again, and none is lost")
def test_an_index_that_is_damaged_or_cannot_be_written_costs_reading_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_of(tmp_path)
    record(store, at(0))
    record(store, at(1))
    index = tmp_path / "windows.jsonl"
    first, second = index.read_bytes().splitlines(keepends=True)
    index.write_bytes(b"\xff{\n" + first + second[:30])
    again = store_of(tmp_path)
    assert stems(again) == [at(0), at(1)]
    assert again.unread("front") == (at(1),)
    disk = Disk(tmp_path, monkeypatch)
    disk.refuses = EVERY_OPERATION
    again.note(at(1), version_of(again.path(at(1))))
    assert again.unread("front") == ()
    disk.refuses = ()
    record(again, at(2))
    assert store_of(tmp_path).unread("front") == ()


@pytest.mark.fault("5,000 windows", "the first list reads the folder once, and no file")
def test_a_list_of_thousands_reads_the_folder_once_and_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Callable[[str, object], None]
) -> None:
    monkeypatch.setattr(window_store, "SETTLED_S", -1.0)
    (tmp_path / "windows").mkdir()
    for number in range(5000):
        (tmp_path / "windows" / f"front-{number}.mcap").write_bytes(b"x")
    store = store_of(tmp_path)
    scans = 0
    real = os.scandir

    def counted(folder: Any) -> Any:
        nonlocal scans
        scans += 1
        return real(folder)

    monkeypatch.setattr(os, "scandir", counted)
    began_s = time.monotonic()
    store.listing("front")
    record_property("figure", f"first list after {time.monotonic() - began_s:.2f} s")
    for _ in range(50):
        store.scan()
        assert len(store.listing("front")) == 5000
        store.usage()
    assert scans <= 1
    (tmp_path / "windows" / "front-7.mcap").unlink()
    store.scan()
    assert len(store.listing("front")) == 4999
    assert scans <= 2


@pytest.mark.fault("old windows that take long to remove", "the list does not wait")
def test_the_list_does_not_wait_for_windows_to_be_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = WindowStore(tmp_path / "windows", StateConfig(min_free_bytes=0, max_bytes=2**20))
    for number in (1, 2, 3):
        store.path(f"front-{number}").write_bytes(bytes(2**19))
    entered, go_on, real = threading.Event(), threading.Event(), os.fsync

    def slow(descriptor: int) -> None:
        entered.set()
        assert go_on.wait(DEADLINE_S)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", slow)
    with ThreadPoolExecutor(2) as pool:
        removing = pool.submit(make_room, store)
        try:
            assert entered.wait(DEADLINE_S)
            reported = pool.submit(store.listing, "front").result(DEADLINE_S / 4)
            store.hold("front-2")  # a question about it has come meanwhile
        finally:
            go_on.set()
        removing.result(DEADLINE_S)
    assert [info.window_id for info in reported] == ["front-2", "front-3"]
    assert [path.stem for path in store.windows("front")] == ["front-2", "front-3"]
    assert store.removed == 1
