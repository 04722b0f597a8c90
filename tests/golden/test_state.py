"""The disk of a vehicle: its files are read to the same values, and written again to the same bytes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from golden.reference import Tolerance, differences, is_identical, plain, read
from golden.state import EXPECTED, RIG_AGAIN, STATE, VALUES, files, values, write_again, write_all

AGAIN = ("state.json", "rig.json", "nominal.json", f"{RIG_AGAIN}/sensors.json")
"""What one process reads whole and writes whole; the others are books to which lines are added."""


@pytest.fixture(scope="module", autouse=True)
def _written(writes: bool) -> None:
    if not writes:
        return
    shutil.rmtree(STATE, ignore_errors=True)
    expected = write_all(STATE)
    EXPECTED.write_text(json.dumps(expected, sort_keys=True) + "\n", encoding="utf-8")
    VALUES.write_text(json.dumps(plain(values(STATE)), sort_keys=True) + "\n", encoding="utf-8")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy: whoever reads may keep something aside."""
    return Path(shutil.copytree(STATE, tmp_path / "copy"))


def test_files_are_read_to_the_same_values(folder: Path) -> None:
    now = json.loads(json.dumps(plain(values(folder))))
    assert not differences(
        read(VALUES), now, Tolerance(0.0 if is_identical() else 1e-9, 0.0 if is_identical() else 1e-12)
    )
    assert files(folder) == files(STATE), "to read changes nothing, and nothing is kept aside"


def test_what_was_read_is_written_to_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    write_again(folder, tmp_path / "again")
    before, after = files(STATE), files(tmp_path / "again")
    assert {name for name in after if not name.endswith(".previous")} == set(AGAIN)
    for name in AGAIN:
        same(name, before[name], after[name], exact=is_identical() or not name.startswith(RIG_AGAIN))


def test_the_same_is_written_of_the_same_decisions(tmp_path: Path) -> None:
    expected = json.loads(json.dumps(write_all(tmp_path / "new")))
    before, after = files(STATE), files(tmp_path / "new")
    assert set(after) == set(before)
    assert not differences(read(EXPECTED), expected, Tolerance(1e-6, 1e-9))
    for name in before:
        same(name, before[name], after[name], exact=is_identical())


def same(name: str, before: bytes, after: bytes, *, exact: bool) -> None:
    """Sums over a text, and identities of it, follow its last digits."""
    if exact or not name.endswith((".json", ".jsonl")):
        assert after == before, name
        return
    for old, new in zip(before.splitlines(), after.splitlines(), strict=True):
        result = differences(documents(old.decode()), documents(new.decode()), Tolerance(1e-6, 1e-9))
        assert all("sha256" in line or "checksum" in line or "hash" in line for line in result), (name, result)


def documents(line: str) -> list[Any]:
    """The JSON objects in a line; books have a checksum before them."""
    decoder, result, at = json.JSONDecoder(), [], line.find("{")
    while at >= 0:
        one, end = decoder.raw_decode(line, at)
        result.append(one)
        at = line.find("{", end)
    return result
