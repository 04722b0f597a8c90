"""Windows recorded before: `coec replay` reaches their decision again, and they are read and written as they were."""

from __future__ import annotations

import json
import runpy
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

import coec
from golden.recorded import FILE, WINDOWS, content, path_of, record
from golden.reference import Tolerance, canonical, differences, is_identical, read, sha256, write
from golden.test_windows import LOOSE
from golden.windows import stored

PACKERS = ("mcap", "zstandard", "lz4", "xxhash")
"""Another version of these may pack the same records into other bytes."""


def packers() -> dict[str, str]:
    return {name: metadata.version(name) for name in PACKERS}


def decided(name: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    """Exit status and document of `coec replay`."""
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["coec", "replay", str(path_of(name)), "--json"])
        with pytest.raises(SystemExit) as finished:
            runpy.run_module("coec", run_name="__main__")
    return int(finished.value.code or 0), json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module", autouse=True)
def _written(writes: bool, tmp_path_factory: pytest.TempPathFactory) -> None:
    if not writes:
        return
    document: dict[str, Any] = {"packers": packers()}
    for name in WINDOWS:
        path_of(name).unlink(missing_ok=True)
        record(name, path_of(name), tmp_path_factory.mktemp("drive"))
        document[name] = {
            "bytes": sha256(path_of(name).read_bytes()),
            "content": sha256(canonical(content(path_of(name)))),
            "result": stored(coec.open(path_of(name)).calibrate().to_json()),
        }
    write(FILE, document)


@pytest.mark.parametrize("name", WINDOWS)
def test_replay_reaches_the_recorded_decision(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    status, document = decided(name, capsys)
    golden = read(FILE)[name]["result"]["values"]
    result = document["result"]
    assert result["verdict"]["decision"] == golden["decision"]
    if is_identical():
        assert (status, document["identical"], document["differences"]) == (0, True, [])
    now = stored(json.dumps(result))["values"]
    assert not differences(golden, now, Tolerance() if is_identical() else LOOSE)


@pytest.mark.parametrize("name", WINDOWS)
def test_a_recorded_window_is_calibrated_to_the_recorded_result(name: str) -> None:
    golden, now = read(FILE)[name]["result"], stored(coec.open(path_of(name)).calibrate().to_json())
    assert not differences(golden["values"], now["values"], Tolerance() if is_identical() else LOOSE)
    if is_identical():
        assert now == golden


@pytest.mark.parametrize("name", WINDOWS)
def test_the_file_is_read_to_the_same_and_written_to_the_same_bytes(name: str, tmp_path: Path) -> None:
    golden = read(FILE)[name]
    assert sha256(path_of(name).read_bytes()) == golden["bytes"]
    assert sha256(canonical(content(path_of(name)))) == golden["content"]
    record(name, tmp_path / "again.mcap", tmp_path / "drive")
    before, after = content(path_of(name)), content(tmp_path / "again.mcap")
    if not is_identical():
        assert not differences(before, after, Tolerance(1e-5, 1e-6))
        return
    assert after == before
    if packers() == read(FILE)["packers"]:
        assert sha256((tmp_path / "again.mcap").read_bytes()) == golden["bytes"]
