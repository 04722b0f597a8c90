"""`coec batch`: windows in, tables and a summary out."""

from __future__ import annotations

import sys
from pathlib import Path

import duckdb
import pytest

from cli.conftest import Coec
from support.fleet import recorded_windows


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_windows(tmp_path_factory.mktemp("recorded"))


def test_a_batch_makes_tables_compares_with_the_vehicles_and_goes_on(
    coec: Coec, recorded: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"rubbish")
    folder = tmp_path / "results"
    first = coec("batch", recorded / "one", bad, "--output", folder, "--jobs", 1, "--json")
    assert first.status == 1
    document = first.document
    assert (document["windows"], document["kept"], document["compared"], document["differing"]) == (2, 0, 1, 0)
    assert document["errors"] == {"bad_window": 1}
    assert "2 of 2" not in first.out
    assert "bad.mcap is damaged" in first.err, "why the first window of each kind of error has no result"

    refused = coec("batch", recorded, "--output", folder)
    assert refused.status == 2
    assert "--resume" in refused.err

    assert "it is a file; name a folder" in coec("batch", recorded, "--output", bad).err

    second = coec("batch", recorded, bad, "--output", folder, "--jobs", 1, "--resume")
    assert second.status == 0
    assert "evaluated before" in second.out
    rows = duckdb.sql(f"SELECT url FROM read_parquet('{folder}/**/*.parquet')").fetchall()
    assert sorted(Path(url).name for (url,) in rows) == ["bad.mcap", "one-1.mcap", "two-1.mcap"]


@pytest.mark.fault("the libraries for tables are not installed", "nothing is written, and the same command works later")
def test_without_the_extra_nothing_is_written(
    coec: Coec, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "results"
    for module in ("pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, module, None)
    outcome = coec("batch", recorded / "one", "--output", folder)
    assert outcome.status == 1
    assert "coec[fleet]" in outcome.err
    assert not folder.exists()


@pytest.mark.fault(
    "a batch fails before its first window, or all windows for a common cause",
    "one message with the way out; the next try is not refused",
)
def test_a_failed_try_leaves_no_folder_that_refuses_the_next(
    coec: Coec, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "results"
    monkeypatch.setitem(sys.modules, "ray", None)  # as if not installed
    no_ray = coec("batch", recorded, "--output", folder, "--engine", "ray")
    assert no_ray.status == 1
    assert "coec[ray]" in no_ray.err
    assert not folder.exists()
    assert coec("batch", recorded, "--output", folder, "--ray-address", "auto").status == 2

    absent = tmp_path / "absent.onnx"
    stopped = coec("batch", recorded, "--output", folder, "--jobs", 1, "--depth", absent)
    assert stopped.status == 1
    assert "absent.onnx" in stopped.err
    assert "--keep-going" in stopped.err
    retained = coec("batch", recorded, "--output", folder, "--jobs", 1, "--depth", absent, "--keep-going", "--json")
    assert retained.document["errors"] == {"bad_model": 2}


def test_what_is_not_the_text_of_a_fleet_is_reported(coec: Coec, tmp_path: Path) -> None:
    reported = tmp_path / "now.json"
    reported.write_text("{}")
    outcome = coec("fleet", "report", tmp_path, "--now", reported)
    assert outcome.status == 2
    assert "is not what `coec watch --once --json` prints" in outcome.err


def test_what_names_no_window_is_an_error(coec: Coec, tmp_path: Path) -> None:
    outcome = coec("batch", f"{tmp_path}/*.mcap", "--output", tmp_path / "results")
    assert outcome.status == 2
    assert "names no window" in outcome.err
