"""The hash chain: what it keeps over a restart, and that no change of it goes unseen."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from pathlib import Path

import pytest

from coec.errors import StateError
from coec.io.serialise import result_of
from coec.io.storage import StateFile
from coec.schemas.message import SCHEMA_VERSION, to_json
from coec.schemas.replies import CalibrationResult, HistoryEntry
from coec.service.records.history import GENESIS, HashChain
from support.disk import EVERY_OPERATION, Disk
from support.estimates import ESTIMATE_RIG, estimate


def result(window: int) -> CalibrationResult:
    return result_of(estimate(window), ESTIMATE_RIG, "test")


def entry(text: str = "something") -> HistoryEntry:
    return HistoryEntry(sequence=0, previous_sha256="", kind="command", code="hold", text=text, wall_ns=1)


def written(path: Path, count: int, limit: int = 100) -> HashChain:
    history = HashChain(path, limit)
    for window in range(count):
        history.append(entry(str(window)), result(window) if window % 2 else None)
        history.flush()
    return history


def test_every_entry_holds_the_hash_of_the_one_before(tmp_path: Path) -> None:
    retained = written(tmp_path / "h", 4).entries()
    previous = GENESIS
    for number, item in enumerate(retained):
        assert (item.entry.sequence, item.entry.previous_sha256) == (number, previous)
        assert item.sha256 == hashlib.sha256(to_json(item.entry)).hexdigest()
        if item.result is not None:
            assert item.entry.result_sha256 == hashlib.sha256(to_json(item.result)).hexdigest()
        previous = item.sha256


def test_a_restart_finds_the_same_chain_and_goes_on(tmp_path: Path) -> None:
    before = written(tmp_path / "h", 4)
    again = HashChain(tmp_path / "h", 100, before.durable_head)
    assert again.damage is None
    assert again.entries() == before.entries()
    assert [retained.result for retained in again.entries()] == [None, result(1), None, result(3)]
    assert again.append(entry()).entry.previous_sha256 == before.entries()[-1].sha256


def test_the_newest_are_retained_and_the_file_stays_bounded(tmp_path: Path) -> None:
    history = written(tmp_path / "h", 20, limit=3)
    assert [item.entry.sequence for item in history.entries()] == [17, 18, 19]
    assert len((tmp_path / "h").read_bytes().splitlines()) <= 6
    again = HashChain(tmp_path / "h", 3, history.durable_head)
    assert again.damage is None
    assert again.entries() == history.entries()


@pytest.mark.fault(
    "an entry of the history changed, removed, swapped or put in", "it is noticed, and the file kept aside"
)
@pytest.mark.parametrize("what", ["text", "result", "removed", "swapped", "inserted"])
def test_any_change_is_noticed_and_the_file_quarantined(tmp_path: Path, what: str) -> None:
    path = tmp_path / "h"
    head = written(path, 5).durable_head
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
    again = HashChain(path, 100, head)
    assert again.damage is not None
    good = 3 if what == "result" else 2
    assert [item.entry.text for item in again.entries()] == [str(i) for i in range(good)]
    assert (tmp_path / "h.broken").read_bytes() == b"".join(changed)
    assert HashChain(path, 100).damage is None, "what is left is sound"


@pytest.mark.fault("the end of the history cut off", "it is noticed")
def test_an_end_that_was_cut_off_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "h"
    head = written(path, 5).durable_head
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:3]))
    assert HashChain(path, 100).damage is None, "the chain alone cannot tell"
    path.write_bytes(path.read_bytes())
    cut = HashChain(path, 100, head)
    assert cut.damage is not None
    assert "cut off" in cut.damage
    assert len(cut.entries()) == 3


@pytest.mark.fault("a power cut in the middle of an entry", "it is not called tampering")
def test_a_torn_last_line_of_a_power_cut_is_no_tampering(tmp_path: Path) -> None:
    path = tmp_path / "h"
    before = written(path, 3)
    path.write_bytes(path.read_bytes() + b"0123 half a li")
    again = HashChain(path, 100, before.durable_head)
    assert again.damage is None
    assert again.entries() == before.entries()
    again.append(entry())
    again.flush()
    assert HashChain(path, 100).damage is None


def test_two_broken_chains_do_not_overwrite_each_other(tmp_path: Path) -> None:
    path = tmp_path / "h"
    for _ in range(2):
        path.write_bytes(b"junk\n")
        assert HashChain(path, 100).damage is not None
    assert {item.name for item in tmp_path.iterdir()} >= {"h.broken", "h.broken-1"}


def test_a_head_that_was_dropped_for_its_age_is_no_tampering(tmp_path: Path) -> None:
    path = tmp_path / "h"
    head = written(path, 1, limit=2).durable_head
    history = HashChain(path, 2, head)
    for number in range(1, 9):
        history.append(entry(str(number)))
        history.flush()
    assert HashChain(path, 2, head).damage is None


def test_another_entry_at_the_place_of_the_head_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    head = written(tmp_path / "other" / "h", 3).durable_head
    history = HashChain(tmp_path / "h", 100)
    for number in range(5):
        history.append(entry(f"forged {number}"))
        history.flush()
    assert HashChain(tmp_path / "h", 100, head).damage is not None


# --- entries of other versions --------------------------------------------------------------------------------------


def append_line(path: Path, entry_fields: dict[str, object], result_fields: dict[str, object] | None = None) -> bytes:
    """Appends an entry as another version of the software would."""
    last = path.read_bytes().splitlines()[-1]
    reported = b"null" if result_fields is None else json.dumps(result_fields).encode()
    fields: dict[str, object] = {
        "sequence": json.loads(last.partition(b" ")[2].partition(b"\t")[0])["sequence"] + 1,
        "previous_sha256": last.partition(b" ")[0].decode(),
        "result_sha256": None if result_fields is None else hashlib.sha256(reported).hexdigest(),
    }
    document = json.dumps(fields | entry_fields).encode()
    line = hashlib.sha256(document).hexdigest().encode() + b" " + document + b"\t" + reported
    with path.open("ab") as stream:
        stream.write(line + b"\n")
    return line


NEWER = {"schema_version": SCHEMA_VERSION + 1, "kind": "towed", "code": {"by": "a lorry"}, "lorry": 7}


@pytest.mark.fault(
    "an entry of an unknown kind in the history, written by a newer version",
    "the chain holds, the entry stays in its place, and the history goes on",
)
def test_an_entry_that_a_newer_version_wrote_stays_in_its_place(tmp_path: Path) -> None:
    path = tmp_path / "h"
    written(path, 3, limit=6)
    line = append_line(path, NEWER)
    again = HashChain(path, 6)
    assert again.damage is None
    assert again.entries()[-1].line == line
    assert again.entries()[-1].entry.sequence == 3
    assert again.append(entry("after it")).entry.previous_sha256 == line.partition(b" ")[0].decode()
    for number in range(12):  # so that the file is written anew at least once
        again.append(entry(str(number)))
        again.flush()
        if number == 3:
            assert line in path.read_bytes().splitlines()
    assert HashChain(path, 6, again.durable_head).damage is None


def test_a_result_that_another_version_wrote_does_not_break_the_chain(tmp_path: Path) -> None:
    path = tmp_path / "h"
    written(path, 2)
    of_window = {"kind": "estimate", "code": "accepted", "text": "", "wall_ns": 1, "window_id": "front-9"}
    line = append_line(path, of_window, {"schema_version": 3, "sigma_rad_m": [0.1]})
    again = HashChain(path, 100)
    assert again.damage is None
    assert (again.entries()[-1].entry.window_id, again.entries()[-1].result) == ("front-9", None)
    assert again.entries()[-1].line == line


@pytest.mark.fault("an entry that this version cannot read and did write, by its own account", "it is called damage")
def test_an_entry_that_this_version_cannot_have_written_breaks_the_chain(tmp_path: Path) -> None:
    path = tmp_path / "h"
    written(path, 2)
    append_line(path, NEWER | {"schema_version": SCHEMA_VERSION})
    assert HashChain(path, 100).damage is not None


@pytest.mark.parametrize(
    "fields", [{"sequence": "x"}, {"previous_sha256": None}, {"result_sha256": 3}, {"sequence": -1}]
)
def test_an_entry_of_another_version_without_its_place_breaks_the_chain(
    tmp_path: Path, fields: dict[str, object]
) -> None:
    path = tmp_path / "h"
    written(path, 2)
    append_line(path, NEWER | fields)
    assert HashChain(path, 100).damage is not None


# --- disks ----------------------------------------------------------------------------------------------------------

LIMIT = 3


class Life:
    """A history and the state file that knows its head, as the service writes them."""

    def __init__(self, root: Path) -> None:
        self.history = HashChain(root / "h", LIMIT)
        self.state = StateFile(root / "state.json")
        self.message = 0

    def append(self) -> int | None:
        """One entry more, then the state: the number of the entry if both say that it is safe."""
        number, self.message = self.message, self.message + 1
        self.history.append(entry(str(number)))
        try:
            self.history.flush()
        except StateError:
            return None
        finally:
            with suppress(StateError):
                self.state.save({"head": self.history.durable_head})
        return number


def assert_restarts(root: Path, safe: int) -> None:
    """Nothing is called tampered with, and entry `safe` (-1: none) and those kept before it are there."""
    body = StateFile(root / "state.json").load().body
    again = HashChain(root / "h", LIMIT, body["head"] if body else None)
    assert again.damage is None
    detected = [int(retained.entry.text) for retained in again.entries()]
    assert detected == list(range(detected[0], detected[-1] + 1)) if detected else safe == -1
    if detected:
        assert detected[-1] >= safe
        assert detected[0] <= max(0, detected[-1] - LIMIT + 1)


@pytest.mark.fault(
    "a disk that refuses writes for a while",
    "no entry of the history is lost, and nothing is called tampered with",
)
@pytest.mark.parametrize("length", [1, 4, *(pytest.param(length, marks=pytest.mark.slow) for length in (2, 30))])
def test_a_disk_that_refuses_for_a_while_loses_nothing_and_is_no_tampering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int
) -> None:
    """Each write, fsync, rename and the like of a life fails once, with `length` - 1 after it."""
    first, refused = 0, True
    while refused:
        root = tmp_path / str(first)
        root.mkdir()
        with monkeypatch.context() as patch:
            disk = Disk(root, patch)
            disk.refuses = range(first, first + length)
            life, safe = Life(root), -1
            for _ in range(8):
                number = life.append()
                safe = safe if number is None else number
                assert_restarts(root, safe)
            refused = disk.operations > first
            disk.refuses = ()
            assert life.append() == 8
            assert_restarts(root, 8)
        first += 1
    assert first > 40


def test_what_waits_is_written_without_another_entry_and_the_head_follows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(tmp_path, monkeypatch)
    history = written(tmp_path / "h", 2)
    before = history.durable_head
    disk.refuses = EVERY_OPERATION
    history.append(entry("third"))
    for _ in range(2):
        with pytest.raises(StateError, match="No space"):
            history.flush()
    assert [retained.entry.text for retained in history.entries()] == ["0", "1", "third"]
    assert history.durable_head == before
    disk.refuses = ()
    history.flush()
    assert history.durable_head != before
    again = HashChain(tmp_path / "h", 100, history.durable_head)
    assert again.damage is None
    assert again.entries() == history.entries()


def test_a_broken_chain_is_quarantined_once_the_disk_takes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(tmp_path, monkeypatch)
    path = tmp_path / "h"
    written(path, 3)
    broken = path.read_bytes().replace(b'"text":"1"', b'"text":"9"')
    path.write_bytes(broken)
    disk.refuses = EVERY_OPERATION
    history = HashChain(path, 100)
    assert history.damage is not None
    assert path.read_bytes() == broken
    disk.refuses = ()
    history.append(entry("on"))
    history.flush()
    assert (tmp_path / "h.broken").read_bytes() == broken
    assert [retained.entry.text for retained in HashChain(path, 100, history.durable_head).entries()] == ["0", "on"]


def test_a_history_that_cannot_be_read_is_damage(tmp_path: Path) -> None:
    (tmp_path / "h").mkdir()
    history = HashChain(tmp_path / "h", 100)
    assert history.damage is not None
    assert "cannot be read" in history.damage
    history.append(entry())
    with pytest.raises(StateError):
        history.flush()


@pytest.mark.fault(
    "a power cut at any byte of the history",
    "no entry that was acknowledged is lost, and nothing is called tampered with",
)
def test_a_power_cut_at_any_byte_loses_nothing_and_is_no_tampering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "disk").mkdir()
    with monkeypatch.context() as patch:
        disk = Disk(tmp_path / "disk", patch)
        life = Life(tmp_path / "disk")
        for attempt in range(8):
            disk.refuses = [number for number in range(1000) if number % 5] if attempt in (2, 3) else ()
            number = life.append()
            if number is not None:
                disk.acknowledge(number)
    count = 0
    for count, cut in enumerate(disk.power_cuts()):
        assert_restarts(cut.restore(tmp_path / str(count)), max(cut.acknowledged, default=-1))
    assert count > 3000
