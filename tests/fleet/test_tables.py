"""The folder of a batch: no finished row is lost, none is there twice, whenever it ends."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import duckdb
import pytest

from coec.errors import OutputError, SourceError, UsageError
from coec.fleet import batch, report
from coec.fleet.batch import BatchFolder
from coec.fleet.evaluator import ReplaySettings, WindowEvaluator
from coec.fleet.jobs import Job, empty_row, lost_row
from coec.fleet.worker_pool import FleetError
from coec.io import storage
from coec.schemas.documents import WindowRow


@pytest.fixture(scope="module")
def row(recorded: Path) -> WindowRow:
    return WindowEvaluator(ReplaySettings()).row(Job(str(recorded / "one" / "one-1.mcap")))


@pytest.fixture(autouse=True)
def small_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "ROWS_A_FILE", 4)


def rows(count: int) -> Iterator[WindowRow]:
    return (empty_row(Job(f"{index}.mcap"), {}) for index in range(count))


def requested(folder: Path, query: str) -> list[tuple[Any, ...]]:
    table = f"read_parquet('{folder}/**/*.parquet', hive_partitioning = true)"
    rows: list[tuple[Any, ...]] = duckdb.sql(query.replace("TABLE", table)).fetchall()
    return rows


def test_a_row_holds_everything_that_was_decided(tmp_path: Path, row: WindowRow) -> None:
    report.write_tables(tmp_path, [row, lost_row(Job("gone.mcap"), "process_died", "it ended")], "part-1")
    result = row.result
    assert result is not None
    ((url, vehicle, date, accepted, rx, sigma, figures, pitch_height, text),) = requested(
        tmp_path,
        "SELECT url, vehicle, date, accepted, rx_deg, sigma_rx_deg, figures, correlation[5], result FROM TABLE"
        " WHERE error IS NULL",
    )
    assert (url, vehicle, accepted) == (row.url, "one", result.verdict.decision == "accepted")
    assert str(date) == "2020-09-13"
    assert (rx, sigma) == (result.correction[0], result.sigma[0])
    assert figures == {name: metric.value for name, metric in result.metrics.items()}
    assert pitch_height == result.correlation_pitch_height
    assert type(result).model_validate_json(text) == result
    ((vehicle, code),) = requested(tmp_path, "SELECT vehicle, error_code FROM TABLE WHERE error IS NOT NULL")
    assert (vehicle, code) == ("unknown", "process_died")


def test_a_vehicle_of_any_name_has_a_folder_within_the_folder(tmp_path: Path) -> None:
    for index, vehicle in enumerate(["../../etc", "a/b", "x=1", "", "Ä ö"]):
        report.write_tables(
            tmp_path, [empty_row(Job(f"{index}"), {}).model_copy(update={"vehicle": vehicle})], f"part-{index}"
        )
    assert len(list(tmp_path.glob("date=unknown/vehicle=*/*.parquet"))) == 5
    assert {name for (name,) in requested(tmp_path, "SELECT vehicle FROM TABLE")} >= {"../../etc", "a/b", "x=1", "Ä ö"}


@pytest.mark.fault("a batch is stopped at any point", "no finished row is lost, and none is written twice")
@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 9])
def test_a_batch_that_ends_anywhere_is_gone_on_with(tmp_path: Path, count: int) -> None:
    first = BatchFolder(tmp_path, ReplaySettings(), resume=False)
    for row in rows(count):
        first.add(row)
    # It is gone without a word.
    second = BatchFolder(tmp_path, ReplaySettings(), resume=True)
    assert second.urls == {row.url for row in rows(count)}
    for row in rows(11):
        if row.url not in second.urls:
            second.add(row)
    second.finish()
    assert requested(tmp_path, "SELECT count(*), count(DISTINCT url) FROM TABLE") == [(11, 11)]
    assert BatchFolder(tmp_path, ReplaySettings(), resume=True).urls == {row.url for row in rows(11)}


def test_rows_are_the_same_whether_a_batch_was_stopped_or_not(tmp_path: Path, row: WindowRow) -> None:
    whole, stopped = (BatchFolder(tmp_path / name, ReplaySettings(), resume=False) for name in ("whole", "stopped"))
    for each in (whole, stopped):
        each.add(row)
    whole.finish()
    BatchFolder(tmp_path / "stopped", ReplaySettings(), resume=True).finish()
    (one,), (other,) = (list((tmp_path / name).rglob("*.parquet")) for name in ("whole", "stopped"))
    assert one.read_bytes() == other.read_bytes()


def test_tables_that_were_made_before_the_journal_was_emptied_are_not_made_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = BatchFolder(tmp_path, ReplaySettings(), resume=False)
    with monkeypatch.context() as patch:

        def gone(*_: object) -> None:
            raise KeyboardInterrupt

        patch.setattr(storage.LineLog, "renew", gone)
        *before, last = rows(4)
        for row in before:
            first.add(row)
        with pytest.raises(KeyboardInterrupt):
            first.add(last)
    second = BatchFolder(tmp_path, ReplaySettings(), resume=True)
    assert len(second.urls) == 4
    second.finish()
    assert requested(tmp_path, "SELECT count(*) FROM TABLE") == [(4,)]


def test_a_torn_or_damaged_line_of_the_journal_costs_its_own_window(tmp_path: Path) -> None:
    first = BatchFolder(tmp_path, ReplaySettings(), resume=False)
    for row in rows(3):
        first.add(row)
    journal = tmp_path / batch.JOURNAL_FILE
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(lines[0] + b'{"url": 3}\n' + lines[2][:-20])
    assert BatchFolder(tmp_path, ReplaySettings(), resume=True).urls == {"0.mcap"}


def test_a_folder_with_a_batch_is_gone_on_with_only_on_request_and_on_the_same_terms(tmp_path: Path) -> None:
    batch = BatchFolder(tmp_path, ReplaySettings(), resume=True)
    batch.add(next(rows(1)))
    with pytest.raises(UsageError, match="--resume"):
        BatchFolder(tmp_path, ReplaySettings(), resume=False)
    with pytest.raises(UsageError, match="another configuration"):
        BatchFolder(tmp_path, ReplaySettings(depth="street"), resume=True)


class FailingEngine:
    """An engine that fails after some rows."""

    cores = 1

    def __init__(self, count: int) -> None:
        self._count = count

    def rows(self, jobs: Sequence[Job], terms: ReplaySettings) -> Iterator[WindowRow]:  # noqa: ARG002 - as the engines
        yield from rows(self._count)
        raise FleetError("the cluster cannot be reached")

    def close(self) -> None:
        """It holds nothing."""


def run(folder: Path, terms: ReplaySettings, engine: FailingEngine) -> None:
    batch.run([Job("0.mcap")], terms, engine, folder, lambda _: None, resume=False)


@pytest.mark.fault("a batch fails before its first window is judged", "the same command can be given again")
def test_a_batch_without_a_row_leaves_nothing_that_refuses_the_next(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    for terms in (ReplaySettings(), ReplaySettings(depth="street")):
        with pytest.raises(FleetError):
            run(folder, terms, FailingEngine(0))
    with pytest.raises(FleetError):
        run(folder, ReplaySettings(), FailingEngine(1))
    with pytest.raises(UsageError, match="--resume"):
        run(folder, ReplaySettings(), FailingEngine(1))


@pytest.mark.fault("a batch fails before its first row", "its folder does not refuse the next try, on whatever terms")
def test_a_folder_without_a_row_holds_no_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "batch"
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pyarrow", None)  # as if not installed
        patch.setitem(sys.modules, "pyarrow.parquet", None)
        with pytest.raises(SourceError, match=r"coec\[fleet\]"):
            BatchFolder(folder, ReplaySettings(), resume=False)
    assert not folder.exists()
    BatchFolder(folder, ReplaySettings(), resume=False).finish()
    BatchFolder(folder, ReplaySettings(depth="street"), resume=False).add(next(rows(1)))
    with pytest.raises(UsageError, match="another configuration"):
        BatchFolder(folder, ReplaySettings(), resume=True)


@pytest.mark.fault(
    "tables of a batch are damaged, its folder cannot be written", "the message says which file, and what to do"
)
def test_what_cannot_be_read_or_written_is_reported(tmp_path: Path) -> None:
    started_batch = BatchFolder(tmp_path / "batch", ReplaySettings(), resume=False)
    for row in rows(4):
        started_batch.add(row)
    (table,) = (tmp_path / "batch").glob("date=*/vehicle=*/*.parquet")
    table.write_bytes(b"PAR1 rubbish PAR1")
    with pytest.raises(SourceError, match="evaluated again"):
        BatchFolder(tmp_path / "batch", ReplaySettings(), resume=True)
    (tmp_path / "batch" / batch.SETTINGS_FILE).write_text("[")
    with pytest.raises(UsageError, match="another folder"):
        BatchFolder(tmp_path / "batch", ReplaySettings(), resume=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        BatchFolder(tmp_path / "file", ReplaySettings(), resume=False)
