"""The record of faults and promises, and its page, say what the marks of the tests say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import pytest

from faults import (
    HELD,
    NOT_RUN,
    PAGE,
    RECORD,
    SELECTED,
    FaultTable,
    Row,
    Selected,
    marked_rows,
    page_of,
    record_of,
    recorded_figures,
    whole_page,
)

MIN_ROWS = 60
"""Faults and attacks that were seen, or are to be expected, on a vehicle."""

RENEW = "run the marked tests: pytest -m '' --faults tests/faults.json"


def key(row: Row) -> tuple[str, str]:
    return row.fault, row.promise


def test_the_record_has_every_marked_row_and_no_other() -> None:
    assert RECORD.read_text(encoding="utf-8") == record_of(marked_rows(), recorded_figures()), RENEW


def test_the_page_shows_the_selected_rows_as_they_are_recorded() -> None:
    assert PAGE.read_text(encoding="utf-8") == page_of(marked_rows(), recorded_figures()), RENEW
    assert 25 <= sum(map(len, SELECTED.values())) <= 40, "the promises that matter most, on one page"


def test_there_are_enough_of_them_and_none_twice() -> None:
    rows = marked_rows()
    assert len(rows) >= MIN_ROWS
    assert len({(row.fault, row.promise) for row in rows}) == len(rows)


def test_every_promise_was_tried_and_held() -> None:
    figures = recorded_figures()
    assert not [row.test for row in marked_rows() if figures[key(row)] == NOT_RUN or "FAILED" in figures[key(row)]]


ROWS = [
    Row("a step", "is detected", "tests/test_a.py::test_a"),
    Row("rain", "is waited for", "tests/test_b.py::test_b"),
]


def test_a_record_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    record = tmp_path / "faults.json"
    record.write_text(record_of(ROWS, {key(ROWS[0]): "0.4 s"}), encoding="utf-8")
    assert recorded_figures(record) == {key(ROWS[0]): "0.4 s", key(ROWS[1]): NOT_RUN}


def test_a_page_shows_what_was_selected_and_refuses_what_no_test_holds() -> None:
    selected = {"Data": (Selected("heavy rain", "is waited for", "rain"),)}
    assert "| heavy rain | is waited for | `tests/test_b.py::test_b` | held |\n" in page_of(
        ROWS, {key(ROWS[1]): HELD}, selected
    )
    for several in ([], [ROWS[1], ROWS[1]._replace(promise="is counted")]):
        with pytest.raises(ValueError, match="marks have the fault 'rain': one is needed"):
            page_of(several, {}, selected)


def test_a_mark_without_its_texts_is_refused(tmp_path: Path) -> None:
    (tmp_path / "test_marked.py").write_text("@pytest.mark.fault('a knock')\ndef test_it(): ...\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"test_marked.py:1: a fault is marked with two literal texts"):
        marked_rows(tmp_path)


@pytest.mark.parametrize(
    ("outcome", "figures", "reported"),
    [("passed", ["0.4 s", "0.5 s"], "0.4 s; 0.5 s"), ("passed", [], HELD), ("failed", ["9 s"], "FAILED")],
)
def test_a_run_writes_what_its_tests_measured_and_what_failed(
    tmp_path: Path, outcome: Literal["passed", "failed"], figures: list[str], reported: str
) -> None:
    row = marked_rows()[0]
    record = tmp_path / "new" / "faults.json"
    writer = FaultTable(record)
    marks = [("fault", json.dumps(row)), *(("figure", figure) for figure in figures)]
    report = pytest.TestReport(row.test, ("", 0, ""), {}, outcome, None, "call", user_properties=marks)
    writer.pytest_runtest_logreport(report)
    assert recorded_figures(record)[key(row)] == reported, "also where the run is ended now"
    writer.pytest_sessionfinish()
    assert recorded_figures(record)[key(row)] == reported


def test_a_later_run_keeps_the_figures_of_tests_that_it_leaves_out(tmp_path: Path) -> None:
    row = marked_rows()[0]
    record = tmp_path / "faults.json"
    record.write_text(record_of([row._replace(test="tests/test_old_name.py::test_it")], {key(row): "0.4 s"}), "utf-8")
    FaultTable(record).pytest_sessionfinish()
    assert recorded_figures(record)[key(row)] == "0.4 s"


def test_the_whole_table_is_a_page_that_begins_with_what_is_recorded(tmp_path: Path) -> None:
    page = tmp_path / "faults.md"
    FaultTable(page).pytest_sessionfinish()
    assert page.read_text(encoding="utf-8") == whole_page(marked_rows(), recorded_figures())
