"""The hash chain: what it keeps over a restart, and that no change of it goes unseen."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from coec.adapters.files.conversions import result_of
from coec.runtime.decisions.history import GENESIS, History
from coec.schemas.base import to_json
from coec.schemas.replies import CalibrationResult, HistoryEntry
from estimates import RIG, estimate


def result(window: int) -> CalibrationResult:
    return result_of(estimate(window), RIG, "test")


def entry(text: str = "something") -> HistoryEntry:
    return HistoryEntry(sequence=0, previous_sha256="", kind="command", code="hold", text=text, wall_ns=1)


def written(path: Path, count: int, limit: int = 100) -> History:
    history = History(path, limit)
    for window in range(count):
        history.append(entry(str(window)), result(window) if window % 2 else None)
    return history


def test_every_entry_holds_the_hash_of_the_one_before(tmp_path: Path) -> None:
    kept = written(tmp_path / "h", 4).entries()
    previous = GENESIS
    for number, item in enumerate(kept):
        assert (item.entry.sequence, item.entry.previous_sha256) == (number, previous)
        assert item.sha256 == hashlib.sha256(to_json(item.entry)).hexdigest()
        if item.result is not None:
            assert item.entry.result_sha256 == hashlib.sha256(to_json(item.result)).hexdigest()
        previous = item.sha256


def test_a_restart_finds_the_same_chain_and_goes_on(tmp_path: Path) -> None:
    before = written(tmp_path / "h", 4)
    again = History(tmp_path / "h", 100, before.head)
    assert again.damage is None
    assert again.entries() == before.entries()
    assert again.results() == (result(1), result(3))
    assert again.append(entry()).entry.previous_sha256 == before.head


def test_the_newest_are_kept_and_the_file_stays_bounded(tmp_path: Path) -> None:
    history = written(tmp_path / "h", 20, limit=3)
    assert [item.entry.sequence for item in history.entries()] == [17, 18, 19]
    assert len((tmp_path / "h").read_bytes().splitlines()) <= 6
    again = History(tmp_path / "h", 3, history.head)
    assert again.damage is None
    assert again.entries() == history.entries()


@pytest.mark.parametrize("what", ["text", "result", "removed", "swapped", "inserted"])
def test_any_change_is_noticed_and_the_file_kept_aside(tmp_path: Path, what: str) -> None:
    path = tmp_path / "h"
    head = written(path, 5).head
    original = path.read_bytes()
    lines = original.splitlines(keepends=True)
    changed = {
        "text": [*lines[:2], lines[2].replace(b'"text":"2"', b'"text":"9"'), *lines[3:]],
        "result": [*lines[:3], lines[3].replace(b'"pairs":3', b'"pairs":4'), lines[4]],
        "removed": [*lines[:2], *lines[3:]],
        "swapped": [*lines[:2], lines[3], lines[2], lines[4]],
        "inserted": [*lines[:2], lines[1], *lines[2:]],
    }[what]
    path.write_bytes(b"".join(changed))
    again = History(path, 100, head)
    assert again.damage is not None
    good = 3 if what == "result" else 2
    assert [item.entry.text for item in again.entries()] == [str(i) for i in range(good)]
    assert (tmp_path / "h.broken").read_bytes() == b"".join(changed)
    assert History(path, 100).damage is None, "what is left is sound"


def test_an_end_that_was_cut_off_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "h"
    head = written(path, 5).head
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:3]))
    assert History(path, 100).damage is None, "the chain alone cannot tell"
    path.write_bytes(path.read_bytes())
    cut = History(path, 100, head)
    assert cut.damage is not None
    assert "cut off" in cut.damage
    assert len(cut.entries()) == 3


def test_a_torn_last_line_of_a_power_cut_is_no_tampering(tmp_path: Path) -> None:
    path = tmp_path / "h"
    before = written(path, 3)
    path.write_bytes(path.read_bytes() + b"0123 half a li")
    again = History(path, 100, before.head)
    assert again.damage is None
    assert again.entries() == before.entries()
    again.append(entry())
    assert History(path, 100).damage is None


def test_two_broken_chains_do_not_overwrite_each_other(tmp_path: Path) -> None:
    path = tmp_path / "h"
    for _ in range(2):
        path.write_bytes(b"junk\n")
        assert History(path, 100).damage is not None
    assert {item.name for item in tmp_path.iterdir()} >= {"h.broken", "h.broken-1"}
