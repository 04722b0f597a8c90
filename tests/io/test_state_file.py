"""The state file: round trip, every flipped bit, cuts, the previous copy, a folder that refuses."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path

import pytest

from coec.errors import StateError
from coec.io.storage import BROKEN, MAX_QUARANTINED, MAX_STATE_BYTES, OLDER, StateFile
from support.disk import EVERY_OPERATION, Disk

FIRST: dict[str, object] = {"pairs": {"front": {"matrix": [[1.0, 0.1], [1e-17, -0.0]], "name": "Ä"}}}
SECOND: dict[str, object] = {"pairs": {"front": {"matrix": [[2.0, 0.30000000000000004], [3, None]]}}}


def saved(folder: Path, *bodies: dict[str, object]) -> Path:
    path = folder / "state.json"
    file = StateFile(path)
    for body in bodies:
        file.save(body)
    return path


def test_nothing_there_is_no_damage(tmp_path: Path) -> None:
    loaded = StateFile(tmp_path / "state.json").load()
    assert loaded.body is None
    assert loaded.damage == ()


def test_what_was_saved_last_is_loaded(tmp_path: Path) -> None:
    path = saved(tmp_path, FIRST, SECOND)
    loaded = StateFile(path).load()
    assert loaded.body == SECOND
    assert loaded.damage == ()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["state.json", "state.json.previous"]


@pytest.mark.fault("any bit of the state file flipped", "it is found, and the previous good copy is served")
def test_any_flipped_bit_is_detected_and_the_previous_copy_served(tmp_path: Path) -> None:
    path = saved(tmp_path, FIRST, SECOND)
    good = path.read_bytes()
    for index in range(len(good)):
        for bit in range(8):
            bad = bytearray(good)
            bad[index] ^= 1 << bit
            path.write_bytes(bad)
            loaded = StateFile(path).load()
            assert loaded.body == FIRST, f"byte {index}, bit {bit}"
            assert len(loaded.damage) == 1


@pytest.mark.fault("a state file cut off at any byte", "it is found; nothing is served without a good copy")
def test_any_cut_is_detected_and_nothing_is_served_without_a_good_copy(tmp_path: Path) -> None:
    path = saved(tmp_path, FIRST)
    good = path.read_bytes()
    for length in range(len(good)):
        path.write_bytes(good[:length])
        loaded = StateFile(path).load()
        assert loaded.body is None
        assert len(loaded.damage) == 1


def test_a_damaged_copy_never_replaces_the_good_previous_one(tmp_path: Path) -> None:
    path = saved(tmp_path, FIRST, SECOND)
    path.write_bytes(b"{")
    file = StateFile(path)
    assert file.load().body == FIRST
    file.save(SECOND)
    path.write_bytes(b"{")
    assert StateFile(path).load().body == FIRST


def by_newer_service(path: Path, body: dict[str, object], checksum: str = "") -> bytes:
    """Writes a file of a later schema version, whose checksum covers that version, too."""

    def canonical(value: object) -> bytes:
        return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()

    checksum = checksum or hashlib.sha256(canonical({"body": body, "schema_version": 7})).hexdigest()
    data = canonical({"body": body, "checksum": checksum, "schema_version": 7})
    path.write_bytes(data)
    return data


@pytest.mark.fault(
    "a state file of a newer schema version", "it is read if its checksum is right, and kept aside, not overwritten"
)
def test_a_file_of_a_newer_schema_version_is_read_and_quarantined(tmp_path: Path) -> None:
    path = saved(tmp_path, FIRST)
    newer = by_newer_service(path, SECOND)
    file = StateFile(path)
    loaded = file.load()
    assert loaded.body == SECOND
    assert loaded.damage == ()
    for body in (FIRST, SECOND, FIRST):
        file.save(body)
    assert (tmp_path / "state.json.newer").read_bytes() == newer
    assert StateFile(path).load().body == FIRST


def test_a_file_of_a_newer_schema_version_with_a_wrong_checksum_is_not_read(tmp_path: Path) -> None:
    path = saved(tmp_path, FIRST)
    newer = by_newer_service(path, SECOND, hashlib.sha256(b"").hexdigest())
    file = StateFile(path)
    loaded = file.load()
    assert loaded.body is None
    assert "newer schema version" in loaded.damage[0]
    file.save(FIRST)
    assert (tmp_path / "state.json.newer").read_bytes() == newer


def test_a_copy_that_is_distrusted_twice_does_not_cost_the_other_copy(tmp_path: Path) -> None:
    path = saved(tmp_path, FIRST, SECOND)
    unusable = path.read_bytes()
    file = StateFile(path)
    file.load()
    file.reject(OLDER)
    file.reject(BROKEN)
    file.reject(OLDER)
    file.save(FIRST)
    assert {entry.name for entry in tmp_path.iterdir()} == {"state.json", "state.json.previous", "state.json.broken"}
    assert (tmp_path / "state.json.broken").read_bytes() == unusable


def test_what_is_quarantined_is_bounded_and_the_first_ones_stay(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    for number in range(2 * MAX_QUARANTINED):
        path.write_bytes(b"junk %d" % number)
        file = StateFile(path)
        assert file.load().damage
        file.save(FIRST)
    offset = {entry.name: entry.read_bytes() for entry in tmp_path.glob("*.broken*")}
    assert len(offset) == MAX_QUARANTINED + 1
    assert offset["state.json.broken"] == b"junk 0"
    assert b"junk %d" % (2 * MAX_QUARANTINED - 1) in offset.values()


def test_a_save_waits_until_what_cannot_be_used_is_quarantined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(tmp_path, monkeypatch)
    path = saved(tmp_path, FIRST)
    path.write_bytes(b"junk")
    file = StateFile(path)
    file.load()
    disk.refuses = EVERY_OPERATION
    with pytest.raises(StateError):
        file.save(FIRST)
    assert path.read_bytes() == b"junk"
    disk.refuses = ()
    file.save(FIRST)
    assert (tmp_path / "state.json.broken").read_bytes() == b"junk"


@pytest.mark.fault("a state file of gigabytes", "it is not read whole")
def test_a_file_larger_than_any_state_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    with path.open("wb") as stream:
        stream.truncate(MAX_STATE_BYTES + 1)
    assert "more than" in StateFile(path).load().damage[0]


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"null",
        b"[]",
        b'{"body":3}',
        b"[" * 100_000,
        b'{"body":{"a":NaN},"schema_version":1}',
        b'{"body":{},"schema_version":%s}' % (b"9" * 4000),
        b'{"body":{"a":%s},"schema_version":1}' % (b"9" * 5000),
    ],
    ids=range(8),
)
def test_foreign_files_are_damage_not_exceptions(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(text)
    loaded = StateFile(path).load()
    assert loaded.body is None
    assert loaded.damage


def test_lists_of_any_depth_are_a_state_or_damage(tmp_path: Path) -> None:
    """Between what Python reads and what it writes lie some depths, wherever its stack has just been. Before Python
    3.12 they lie below its limit of recursion, 1000; later versions measure the stack of C."""
    depths = (*range(100, 1000), 1_000_000)
    path = tmp_path / "state.json"
    damaged = 0
    for depth in depths:
        body = f'{{"pairs":{"[" * depth + "]" * depth}}}'.encode()
        checksum = hashlib.sha256(body).hexdigest()
        path.write_bytes(b'{"body":%b,"checksum":"%b","schema_version":1}' % (body, checksum.encode()))
        damaged += bool(StateFile(path).load().damage)
    assert 0 < damaged < len(depths)


def test_a_failed_write_is_an_error_and_keeps_the_old_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path, FIRST)
    file = StateFile(path)
    file.load()

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StateError, match="No space left"):
        file.save(SECOND)
    monkeypatch.undo()
    assert StateFile(path).load().body == FIRST
    assert [entry.name for entry in tmp_path.iterdir()] == ["state.json"]


@pytest.mark.fault("a power cut at any byte of a save of the state", "what was saved last, or is being saved, is there")
def test_a_power_cut_at_any_byte_of_the_saves_leaves_what_was_saved_last_or_is_being_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "disk").mkdir()
    bodies: list[dict[str, object]] = [FIRST, SECOND, {"pairs": {}}, FIRST]
    with monkeypatch.context() as patch:
        disk = Disk(tmp_path / "disk", patch)
        file = StateFile(tmp_path / "disk" / "state.json")
        for number, body in enumerate(bodies):
            file.save(body)
            disk.acknowledge(number)
    count = 0
    for count, cut in enumerate(disk.power_cuts()):
        loaded = StateFile(cut.restore(tmp_path / str(count)) / "state.json").load()
        safe = len(cut.acknowledged)
        assert loaded.body in (None, *bodies)[safe : safe + 2]
        assert loaded.damage == ()
    assert count > 400


@pytest.mark.fault(
    "a disk that refuses any call of a save of the state", "a good copy is there, and the next save works"
)
@pytest.mark.parametrize("length", [1, 3])
def test_whatever_the_disk_refuses_a_good_copy_is_there_and_the_next_save_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int
) -> None:
    for first in range(12):
        root = tmp_path / str(first)
        root.mkdir()
        with monkeypatch.context() as patch:
            disk = Disk(root, patch)
            file = StateFile(root / "state.json")
            file.save(FIRST)
            begins = disk.operations + first
            disk.refuses = range(begins, begins + length)
            with suppress(StateError):
                file.save(SECOND)
            loaded = StateFile(root / "state.json").load()
            assert loaded.body in (FIRST, SECOND)
            assert loaded.damage == ()
            disk.refuses = ()
            file.save(SECOND)
            assert StateFile(root / "state.json").load().body == SECOND


def test_a_file_that_somebody_removed_is_written_again(tmp_path: Path) -> None:
    file = StateFile(tmp_path / "state.json")
    file.save(FIRST)
    (tmp_path / "state.json").unlink()
    file.save(SECOND)
    assert StateFile(tmp_path / "state.json").load().body == SECOND
