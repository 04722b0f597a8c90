"""The fuzzer itself: it finds what only its feedback can lead to, tells what took too long or too much, and goes the
same way again."""

from __future__ import annotations

import io
import zipfile
from contextlib import suppress
from pathlib import Path
from random import Random

import numpy as np
import pytest

from coec.errors import SourceError
from coec.io.mcap.reader import McapDamagedError, read_records
from coec.io.storage import StateFile
from coec.service.records.history import HashChain
from fuzz import loop
from fuzz.formats import chained, checksummed, in_archive, in_json, in_records, in_yaml
from fuzz.loop import Finding, Fuzzer, Report, Target, smallest_with_all_arcs, tried
from fuzz.mutate import deepened
from fuzz.targets import TARGETS

HERE = Path(__file__).resolve().parent
ENOUGH = 4000
"""Inputs: four right letters in a row are guessed once in 2^32."""


def letter_by_letter(data: bytes, folder: Path) -> None:
    del folder
    if data[:1] == b"F":
        if data[1:2] == b"U":
            if data[2:3] == b"Z":
                raise ZeroDivisionError
            raise SourceError("not yet")
        raise SourceError("hardly")
    raise SourceError("not at all")


LETTERS = Target("letters", letter_by_letter, lambda: [b"AAAA"], labels=(b"F", b"U", b"Z", b"Q", b"X"))


def fuzzed(target: Target, folder: Path, seed: int = 1, executions: int = ENOUGH) -> Report:
    fuzzer = Fuzzer(target, folder, seed, code=HERE)
    fuzzer.replay(target.seeds())
    return fuzzer.mutate(lambda report: report.executions >= executions or bool(report.findings))


def test_what_leads_further_is_retained_until_the_fault_is_detected(tmp_path: Path) -> None:
    report = fuzzed(LETTERS, tmp_path)
    (finding,) = report.findings.values()
    assert finding.place == "ZeroDivisionError outside"
    assert finding.data[:3] == b"FUZ"
    assert [data[:2] for data in report.corpus if data[:2] == b"FU"]


def test_the_same_seed_goes_the_same_way(tmp_path: Path) -> None:
    first, again, other = (fuzzed(LETTERS, tmp_path, seed, 300) for seed in (1, 1, 2))
    assert (first.executions, first.corpus) == (again.executions, again.corpus)
    assert first.corpus != other.corpus


def test_few_inputs_stand_for_all(tmp_path: Path) -> None:
    inputs = [b"A", b"B", b"C", b"{", b"\x80"]
    selected = smallest_with_all_arcs(TARGETS["ego"], tmp_path, [*TARGETS["ego"].seeds(), *inputs], 1000)
    assert 1 < len(selected) < 5


def test_an_input_that_takes_long_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(data: bytes, folder: Path) -> None:
        del folder
        if data == b"long":
            while True:
                pass

    monkeypatch.setattr(loop, "HUNG_CPU_S", 0.05)
    target = Target("busy", busy, lambda: [b""])
    assert tried(target, b"", tmp_path).problem is None
    assert tried(target, b"long", tmp_path).problem == ("time", "more than 0.05 s")
    fuzzer = Fuzzer(target, tmp_path, 1)
    assert [finding.place for finding in fuzzer.replay([b"long"]).findings.values()] == ["time"]


def test_an_input_that_takes_much_memory_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def large(data: bytes, folder: Path) -> None:
        del folder
        np.ones(len(data) * 2**17)

    monkeypatch.setattr(loop, "MAX_BYTES", 2**20)
    fuzzer = Fuzzer(Target("large", large, lambda: [b""]), tmp_path, 1)
    assert fuzzer.replay([b"", b"1" * 64]).findings.keys() == {"memory"}


def test_the_smallest_input_of_a_finding_is_reported(tmp_path: Path) -> None:
    fuzzer = Fuzzer(LETTERS, tmp_path, 1, code=HERE)
    report = fuzzer.replay([b"FUZZZ", b"FUZ", b"FUZZ"])
    assert report.findings.keys() == {"ZeroDivisionError outside"}
    assert isinstance(next(iter(report.findings.values())), Finding)
    assert [finding.data for finding in report.findings.values()] == [b"FUZ"]


# --- what is forged passes for sound: not always, as what was put into it may be of no such file ----------------------

SEEDS = range(40)


def test_a_forged_state_has_the_right_checksum(tmp_path: Path) -> None:
    whole = TARGETS["state"].seeds()[0]
    path = tmp_path / "state.json"
    loaded = 0
    for seed in SEEDS:
        path.write_bytes(checksummed(Random(seed), whole))
        loaded += StateFile(path).load().body is not None
    assert loaded > len(SEEDS) / 2


def test_a_forged_history_has_the_right_hashes(tmp_path: Path) -> None:
    whole = TARGETS["books"].seeds()[0][1:]
    sound = 0
    for seed in SEEDS:
        (tmp_path / "h").write_bytes(chained(Random(seed), whole))
        chain = HashChain(tmp_path / "h", 10)
        sound += chain.damage is None and len(chain.entries()) == 2
    assert sound > len(SEEDS) / 10


def test_forged_records_make_a_whole_file() -> None:
    whole = TARGETS["bag"].seeds()[0]
    sound = 0
    for seed in SEEDS:
        with suppress(McapDamagedError):
            sound += len(list(read_records(io.BytesIO(in_records(Random(seed), whole))))) > 1
    assert sound > len(SEEDS) / 4


def test_a_forged_archive_has_the_right_sums() -> None:
    for seed in SEEDS:
        with zipfile.ZipFile(io.BytesIO(in_archive(Random(seed), TARGETS["npz"].seeds()[1]))) as archive:
            assert archive.testzip() is None


def test_lists_in_one_another_are_as_deep_as_was_requested() -> None:
    assert deepened(b'{"a": "@deep3@", "b": "@deep0@"}') == b'{"a": [[[]]], "b": }'
    assert any(b"[" * 100 in in_json(Random(seed), b'{"a": 1}') for seed in range(400))
    assert any(b"[" * 30 in in_yaml(Random(seed), b"a: 1") for seed in range(400))
