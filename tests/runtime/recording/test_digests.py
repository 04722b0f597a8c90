"""Windows that nobody reported are read a little at a time, and no fault of one keeps the others from it."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from coec.config import StateConfig
from coec.runtime.recording.digests import DigestReader
from coec.runtime.recording.window_store import WindowStore

PIECE = 1000


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
    assert store.unread("front") == (path,)
