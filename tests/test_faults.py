"""docs/faults.md says what the tests say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import pytest

from faults import HELD, NOT_RUN, TABLE, FaultTable, Row, marked_rows, recorded_figures, table_of

MIN_ROWS = 60
"""Faults and attacks that were seen, or are to be expected, on a vehicle."""


def test_the_table_has_every_marked_row_and_no_other() -> None:
    rows = marked_rows()
    assert TABLE.read_text(encoding="utf-8") == table_of(rows, recorded_figures()), (
        "run the marked tests: pytest -m '' --faults docs/faults.md"
    )


def test_there_are_enough_of_them_and_none_twice() -> None:
    rows = marked_rows()
    assert len(rows) >= MIN_ROWS
    assert len({(row.fault, row.promise) for row in rows}) == len(rows)


def test_every_promise_was_tried_and_held() -> None:
    figures = recorded_figures()
    assert not [row.test for row in marked_rows() if figures[row] == NOT_RUN or "FAILED" in figures[row]]


def test_a_table_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    rows = [
        Row("a knock", "is seen", "tests/test_a.py::test_a"),
        Row("rain", "is waited for", "tests/test_b.py::test_b"),
    ]
    table = tmp_path / "faults.md"
    table.write_text(table_of(rows, {rows[0]: "0.4 s"}), encoding="utf-8")
    assert recorded_figures(table) == {rows[0]: "0.4 s", rows[1]: NOT_RUN}


def test_a_mark_without_its_texts_is_refused(tmp_path: Path) -> None:
    (tmp_path / "test_marked.py").write_text("@pytest.mark.fault('a knock')\ndef test_it(): ...\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"test_marked.py:1: a fault is marked with two literal texts"):
        marked_rows(tmp_path)


@pytest.mark.parametrize(
    ("outcome", "figures", "told"),
    [("passed", ["0.4 s", "0.5 s"], "0.4 s; 0.5 s"), ("passed", [], HELD), ("failed", ["9 s"], "FAILED")],
)
def test_a_run_writes_what_its_tests_measured_and_what_failed(
    tmp_path: Path, outcome: Literal["passed", "failed"], figures: list[str], told: str
) -> None:
    row = marked_rows()[0]
    writer = FaultTable(tmp_path / "faults.md")
    marks = [("fault", json.dumps(row)), *(("figure", figure) for figure in figures)]
    report = pytest.TestReport(row.test, ("", 0, ""), {}, outcome, None, "call", user_properties=marks)
    writer.pytest_runtest_logreport(report)
    assert recorded_figures(tmp_path / "faults.md")[row] == told, "also where the run is ended now"
    writer.pytest_sessionfinish()
    assert recorded_figures(tmp_path / "faults.md")[row] == told


def test_a_later_run_keeps_the_figures_of_tests_that_it_leaves_out(tmp_path: Path) -> None:
    row = marked_rows()[0]
    table = tmp_path / "faults.md"
    table.write_text(table_of([row], {row: "0.4 s"}), encoding="utf-8")
    FaultTable(table).pytest_sessionfinish()
    assert recorded_figures(table)[row] == "0.4 s"
