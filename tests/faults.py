"""docs/faults.md: every fault and attack that a test holds a promise against, written from the tests' own marks.

A test says what it stands for with ``@pytest.mark.fault(fault, promise)``, and what it measured, where it measures
something, with pytest's ``record_property("figure", "0.4 s")``. The table is written by a run of those tests::

    pytest -m '' --faults docs/faults.md            everything, the long forms too
    pytest tests/runtime --faults docs/faults.md    some of it: the rows of the other tests keep their last figure
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

TESTS = Path(__file__).resolve().parent
TABLE = TESTS.parent / "docs" / "faults.md"
HELD = "held"
NOT_RUN = "not run yet"
HEAD = f"""# Faults and attacks

What `coec` promises when something goes wrong, and the test that holds it to the promise. The tests write this table
(`pytest -m '' --faults docs/faults.md`). Each row is a mark on a test. The figure is what that test last measured, or
`{HELD}` for a test that only passes or fails.

| fault or attack | promise | test | last figure |
|---|---|---|---|
"""


class Row(NamedTuple):
    """One promise: what goes wrong, what holds all the same, and the test (``path::name``) that says so."""

    fault: str
    promise: str
    test: str


def marked_rows(tests: Path = TESTS) -> list[Row]:
    """All rows that the tests below a folder are marked with, by file and then by line.

    Raises:
        ValueError: a mark whose two texts are not written out at the mark itself.
    """
    return [row for path in sorted(tests.rglob("test_*.py")) for row in _rows_of(path, tests)]


def _rows_of(path: Path, tests: Path) -> Iterator[Row]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.FunctionDef | ast.ClassDef):
            continue
        for mark in node.decorator_list:
            if not isinstance(mark, ast.Call) or not ast.unparse(mark.func).endswith("mark.fault"):
                continue
            texts = [argument.value for argument in mark.args if isinstance(argument, ast.Constant)]
            match texts:
                case [str(fault), str(promise)]:
                    yield Row(fault, promise, f"{path.relative_to(tests.parent).as_posix()}::{node.name}")
                case _:
                    raise ValueError(f"{path}:{mark.lineno}: a fault is marked with two literal texts: fault, promise")


def recorded_figures(table: Path = TABLE) -> dict[Row, str]:
    """The last figure of every row of a table that was written before; none where there is no table."""
    if not table.exists():
        return {}
    lines = table.read_text(encoding="utf-8").splitlines()
    cells = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ") and line.count(" | ") == 3]
    return {Row(fault, promise, test.strip("`")): figure for fault, promise, test, figure in cells[1:]}


def table_of(rows: Sequence[Row], figures: Mapping[Row, str]) -> str:
    """The document: one line a row, in the order of the tests."""
    lines = (f"| {row.fault} | {row.promise} | `{row.test}` | {figures.get(row, NOT_RUN)} |\n" for row in rows)
    return HEAD + "".join(lines)


class FaultTable:
    """The pytest plugin: gathers what marked tests measured, and writes the table after each of them: what was measured
    before a run is ended stays."""

    def __init__(self, table: Path) -> None:
        self._table = table
        self._rows = marked_rows()
        self._figures: dict[Row, list[str]] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take in a test's figures when it has run, or that it failed (also in its fixtures)."""
        marked = [value for name, value in report.user_properties if name == "fault" and isinstance(value, str)]
        if report.when != "call" and not report.failed:
            return
        figures = [str(value) for name, value in report.user_properties if name == "figure"]
        for row in (Row(*json.loads(text)) for text in marked):
            self._figures.setdefault(row, []).extend(["FAILED"] if report.failed else figures)
        if marked:
            self._write()

    def pytest_sessionfinish(self) -> None:
        """Write the table, also where no marked test was run: rows whose tests are gone go with them."""
        self._write()

    def _write(self) -> None:
        """Rows of this run with their figures, all others with the last that is told."""
        figures = recorded_figures(self._table)
        for row, measured in self._figures.items():
            figures[row] = "; ".join(dict.fromkeys(measured)) or HELD
        self._table.write_text(table_of(self._rows, figures), encoding="utf-8")


def rows_of_item(item: pytest.Item) -> list[Row]:
    """The rows that a collected test is marked with, its own and those of its class."""
    rows: list[Row] = []
    for node, mark in item.iter_markers_with_node("fault"):
        fault, promise = mark.args
        name = node.name.partition("[")[0]
        rows.append(Row(fault, promise, f"{item.path.relative_to(TESTS.parent).as_posix()}::{name}"))
    return rows
