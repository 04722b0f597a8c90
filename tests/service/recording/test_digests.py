"""Windows that nobody reported are read a little at a time, and no fault of one keeps the others from it."""

from __future__ import annotations

import hashlib
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO, cast

import pytest

from coec.config import StateConfig
from coec.service.recording import recorder as digests_module
from coec.service.recording.recorder import DigestReader
from coec.service.recording.window_store import WindowStore

PIECE = 1000
DEADLINE_S = 20.0


@pytest.fixture
def store(tmp_path: Path) -> WindowStore:
    return WindowStore(tmp_path / "windows", StateConfig(min_free_bytes=0))


def put(store: WindowStore, number: int, size: int = 3 * PIECE) -> Path:
    path = store.path(f"front-{number}")
    path.write_bytes(bytes([number]) * size)
    os.utime(path, ns=(number, number))
    return path


def read_all(reader: DigestReader) -> int:
    rounds = 0
    while reader.read(PIECE):
        rounds += 1
        assert rounds < 100
    return rounds


def digests(store: WindowStore) -> dict[str, str | None]:
    return {info.window_id: info.sha256 for info in store.listing("front")}


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_every_window_is_read_in_pieces_the_latest_first(store: WindowStore) -> None:
    paths = [put(store, number) for number in (1, 2, 3)]
    reader = DigestReader(store, "front")
    store.scan()
    for _ in range(4):  # three pieces, and the end
        assert digests(store)["front-3"] is None
        assert reader.read(PIECE)
    assert digests(store) == {"front-1": None, "front-2": None, "front-3": sha256(paths[2])}
    assert read_all(reader) == 8
    assert digests(store) == {path.stem: sha256(path) for path in paths}
    assert not reader.read(PIECE)
    # They are no windows of ours, but whoever wants to know why can have them.
    assert [(info.pairs, info.decision) for info in store.listing("front")] == 3 * [(None, None)]


def test_a_window_that_is_replaced_meanwhile_is_read_once_more(store: WindowStore) -> None:
    path = put(store, 1)
    reader = DigestReader(store, "front")
    assert reader.read(PIECE)
    other = path.with_suffix(".tmp")
    other.write_bytes(b"other")
    other.replace(path)
    read_all(reader)
    assert digests(store) == {"front-1": hashlib.sha256(b"other").hexdigest()}


def test_a_window_that_goes_or_cannot_be_read_is_passed_over(
    store: WindowStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, bad, gone = (put(store, number) for number in (1, 2, 3))
    reader = DigestReader(store, "front")
    assert reader.read(PIECE)
    gone.unlink()
    real = Path.open

    def opened(path: Path, mode: str = "r") -> object:
        if path == bad:
            raise PermissionError(13, "Permission denied")
        return real(path, mode)

    monkeypatch.setattr(Path, "open", opened)
    read_all(reader)
    assert digests(store) == {"front-1": sha256(good), "front-2": None}
    assert not reader.read(PIECE), "it is not tried again and again"


def test_closing_leaves_the_window_unread(store: WindowStore) -> None:
    path = put(store, 1)
    reader = DigestReader(store, "front")
    assert reader.read(PIECE)
    reader.close()
    reader.close()
    assert store.unread("front") == (path.stem,)


@pytest.mark.fault(
    "gigabytes of unknown windows on a slow disk", "the list is there at once, and reading never blocks the heartbeat"
)
def test_on_a_slow_disk_a_round_is_short_and_the_list_is_there_at_once(
    store: WindowStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = put(store, 1, 2**20)
    now_s, gives_bytes_per_s = [0.0], 100_000
    real = Path.open

    class Slow:
        def __init__(self, stream: BinaryIO) -> None:
            self._stream = stream
            self.fileno, self.close = stream.fileno, stream.close

        def read(self, size: int) -> bytes:
            data = self._stream.read(size)
            now_s[0] += len(data) / gives_bytes_per_s
            return data

    monkeypatch.setattr(digests_module, "_result_in", lambda _: None)
    monkeypatch.setattr(Path, "open", lambda path, mode="r": Slow(cast(BinaryIO, real(path, mode))))
    reader = DigestReader(store, "front", lambda: now_s[0])
    longest_s = 0.0
    store.scan()
    while True:
        before_s, reported = now_s[0], digests(store)
        if not reader.read(4 * 2**20):
            break
        assert reported == {"front-1": None}, "the list waits for no reading"
        longest_s = max(longest_s, now_s[0] - before_s)
    assert longest_s < 1.0
    monkeypatch.undo()
    assert digests(store) == {"front-1": sha256(path)}


@pytest.mark.fault("a disk that hangs while the index is written", "the list of windows does not wait")
def test_the_list_does_not_wait_for_the_index_to_be_written(
    store: WindowStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(store, 1)
    entered, go_on, real = threading.Event(), threading.Event(), os.fsync

    def slow(descriptor: int) -> None:
        entered.set()
        assert go_on.wait(DEADLINE_S)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", slow)
    with ThreadPoolExecutor(2) as pool:
        reading = pool.submit(read_all, DigestReader(store, "front"))
        try:
            assert entered.wait(DEADLINE_S)
            reported = pool.submit(digests, store).result(DEADLINE_S / 4)
            assert pool.submit(store.usage).result(DEADLINE_S / 4).used == 3 * PIECE
        finally:
            go_on.set()
        reading.result(DEADLINE_S)
    assert reported == digests(store)
