"""Faults and attacks, and the promises that tests hold against them.

A test says what it stands for with ``@pytest.mark.fault(fault, promise)``, and what it measured, where it measures
something, with pytest's ``record_property("figure", "0.4 s")``. The whole table, with what was last measured, is
committed as ``tests/faults.json``; ``docs/faults.md`` shows the promises of ``CHOSEN``. A run of marked tests writes
them, and rows of tests that it leaves out keep their last figure::

    pytest -m '' --faults tests/faults.json          everything, the long forms too, and docs/faults.md
    pytest tests/soak --faults tests/faults.json     some of it
    pytest tests/soak --faults build/faults.md       the whole table as a page to read; git ignores that folder
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

TESTS = Path(__file__).resolve().parent
RECORD = TESTS / "faults.json"
PAGE = TESTS.parent / "docs" / "faults.md"
HELD = "held"
NOT_RUN = "not run yet"

WHOLE_HEAD = """# Faults and attacks

| fault or attack | promise | test | last figure |
|---|---|---|---|
"""

PAGE_HEAD = f"""# Faults and attacks

What `coec` promises when something goes wrong. These are the promises that matter most; the tests hold {{count}} of
them. Each row names the test that tries the fault, and what that test last measured (`{HELD}`: it passes or fails, and
measures nothing). `tests/faults.json` has all rows. `pytest -m '' --faults build/faults.md` runs the tests and writes
the whole table as a page. The checks fail if a promise was not tried, or was not held.
"""


class Row(NamedTuple):
    """One promise: what goes wrong, what holds all the same, and the test (``path::name``) that says so."""

    fault: str
    promise: str
    test: str


Figures = Mapping[tuple[str, str], str]
"""What was last measured, by fault and promise: a test that is renamed keeps its figure."""


class Selected(NamedTuple):
    """A row of the page for people. `mark` is the fault as a test is marked with it, and `held` the promise, where
    several marks have the same fault."""

    fault: str
    promise: str
    mark: str
    held: str | None = None


SELECTED: Mapping[str, tuple[Selected, ...]] = {
    "Calibration": (
        Selected(
            "fog, blur, wrong stamps, torn clouds or foreign pictures in a window",
            "no wrong pose is accepted",
            "windows with fog, blur, wrong stamps, torn clouds, foreign pictures",
        ),
        Selected(
            "a window whose estimate is refused",
            "it is never served",
            "an estimate that failed",
        ),
        Selected(
            "one wrong window between right ones",
            "the served extrinsic stays",
            "a single wrong window",
        ),
        Selected(
            "the mount is displaced within a window",
            "the window is refused, and gives the time of the displacement",
            "a knock in the middle of a window",
        ),
        Selected(
            "intrinsics that are wrong by 2 % or 4 px",
            "the window reports it, with the size of the error",
            "intrinsics that are off by 2 % or by four pixels",
        ),
    ),
    "Monitor and health": (
        Selected(
            "the mount of a running service is displaced by 1°",
            "it is detected, corrected, and remembered over a restart",
            "the mount moves by a degree while the service runs",
        ),
        Selected(
            "the mount drifts by 0.05° a minute for half an hour",
            "while the pair is healthy, the served extrinsic is at most 0.3° off",
            "a mount that drifts by 0.05° a minute, for half an hour",
        ),
        Selected(
            "any sequence of checks, windows, commands, silence, restarts and clock steps",
            "`healthy` means that a check acquitted the served extrinsic within three periods, or where it stands",
            "20,000 such sequences",
        ),
        Selected(
            "checks never complete, for whatever reason",
            "after three periods no pair is healthy",
            "checks that never complete, for whatever reason",
        ),
        Selected(
            "steps in traffic, frozen sensors, wrong odometry, turned or loose mounts, another lens",
            "`healthy` until the third check is answered at most while the extrinsic is wrong",
            "steps at a standstill and in traffic, stuck odometry, frozen sensors, turned and loose mounts, "
            "another lens",
        ),
        Selected(
            "tunnels, open roads and nights with a right mount",
            "no false alarm; no state changes without its reason, or more than once a minute",
            "tunnels, open roads and nights with a mount that is right",
        ),
        Selected(
            "the wall clock jumps by a year while the service runs",
            "no pair is healthy for long without a check, and no window is lost",
            "a wall clock that steps by -400 days, an hour or 100 days while the service runs",
        ),
        Selected(
            "one LiDAR of a rig is displaced by 1.5°",
            "it alone is named, within a minute; one correction for all of its pairs",
            "the LiDAR of a running vehicle is knocked by 1.5°",
        ),
    ),
    "Data": (
        Selected(
            "streams late and out of step, a slow worker, a stalling clock",
            "the same windows and checks as undisturbed, to the byte",
            "streams late and out of step, a slow worker, a stalling clock",
        ),
        Selected(
            "two publishers on one topic",
            "frames of neither are used, and health names both, until one ends",
            "two publishers on one topic of a running service",
        ),
        Selected(
            "every fault of messages at full rate for half an hour",
            "every message is accounted for, and memory stays",
            "every fault at full rate for half an hour (three minutes in the gate)",
        ),
        Selected(
            "messages of 22 and 30 MB for 15 s",
            "memory stays bounded, and is returned within a minute",
            "15 s of messages of 22 and 30 MB",
        ),
        Selected(
            "a ROS message of any type with any bytes",
            "a value or an error, within 5 s and 500 MB; so for every reader of foreign bytes",
            "a ROS message of any type, of any bytes",
        ),
    ),
    "Disk, restart, update": (
        Selected(
            "`kill -9` at any moment under load",
            "nothing that a client was told is lost",
            "kill -9 at any moment under load, again and again",
        ),
        Selected(
            "a power cut at any byte while the state is saved",
            "the last saved state, or the one that was being saved, is read",
            "a power cut at any byte of a save of the state",
        ),
        Selected(
            "a disk that is full, read-only, or gives 100 kB/s",
            "health names it within 5 s, commands are answered within 100 ms, and all is written afterwards",
            "a disk that is full, read-only or gives 100 kB/s for 16 s",
        ),
        Selected(
            "any bit of the state file flipped",
            "it is detected, and the previous good copy is served",
            "any bit of the state file flipped",
        ),
        Selected(
            "an update of the software",
            "no pair becomes healthy by it, and a miscalibrated pair stays so",
            "an update of the software",
            "nothing is green that was not, and a miscalibrated pair stays so",
        ),
        Selected(
            "an entry of the history changed, removed, swapped or inserted",
            "it is detected, and the file is kept aside",
            "an entry of the history changed, removed, swapped or put in",
        ),
    ),
    "Worker and service": (
        Selected(
            "the worker crashes, hangs, grows too large or sends rubbish",
            "another one solves the window",
            "a worker that crashes, hangs, grows too large or sends rubbish",
        ),
        Selected(
            "any sequence of crashes, deadlines and floods of jobs",
            "every job ends exactly once",
            "any sequence of crashes, deadlines and floods of jobs",
        ),
        Selected(
            "a thread of the service dies",
            "health and ROS get the reason, and the process ends with an exit code of its own",
            "a thread of the service dies",
        ),
        Selected(
            "two daemons of one vehicle, started in any order",
            "never do two serve, and always does one",
            "several daemons of a vehicle start in any order of looks",
        ),
        Selected(
            "no router at the start, one that restarts, one that moves",
            "samples, queries and tokens come back each time",
            "no router at the start, one that restarts, and one that moves to the second endpoint",
        ),
    ),
    "Security": (
        Selected(
            "a command with the certificate of a viewer, a sensor or a node",
            "the router does not forward it",
            "a command with the certificate of a viewer, a sensor or a node",
        ),
        Selected(
            "an authenticated command that is changed, cut or repeated on its way",
            "it is not carried out",
            "a proven command that is changed, cut or repeated on its way",
        ),
        Selected(
            "secrets in endpoints, Zenoh files and keys, over a whole run",
            "none is in any reply, log, command line, window, incident or state",
            "secrets in endpoints, in the Zenoh file and in private keys, over a whole life with a moved mount and a "
            "restart",
        ),
        Selected(
            "control sequences in every text that a vehicle sends",
            "terminals show them as escapes",
            "control sequences in every text of every reply",
        ),
        Selected(
            "the container image, with every depth network at hand",
            "it speaks to nobody but the router",
            "an image built from the Dockerfile, with every depth network at hand",
        ),
    ),
    "Fleet": (
        Selected(
            "a Ray node dies, or falls silent, while it evaluates a window",
            "other nodes evaluate its windows, once each, within a minute",
            "a Ray node is killed, or falls silent, while it judges a window",
        ),
        Selected(
            "a vehicle that sends no heartbeat any more",
            "its last state is shown as old, never as live",
            "a vehicle that says nothing any more",
        ),
    ),
}
"""The rows of the page, by section."""


@cache
def marked_rows(tests: Path = TESTS) -> tuple[Row, ...]:
    """All rows that the tests below a folder are marked with, by file and then by line.

    Raises:
        ValueError: a mark whose two texts are not written out at the mark itself.
    """
    return tuple(row for path in sorted(tests.rglob("test_*.py")) for row in _rows_of(path, tests))


def _rows_of(path: Path, tests: Path) -> Iterator[Row]:
    source = path.read_text(encoding="utf-8")
    if "mark.fault" not in source:  # most files, and parsing all takes seconds
        return
    for node in ast.walk(ast.parse(source)):
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


def recorded_figures(record: Path = RECORD) -> dict[tuple[str, str], str]:
    """The last figure of every promise of a record that was written before; none where there is no record."""
    if not record.exists():
        return {}
    rows = json.loads(record.read_text(encoding="utf-8"))
    return {(row["fault"], row["promise"]): row["figure"] for row in rows}


def _figure(row: Row, figures: Figures) -> str:
    return figures.get((row.fault, row.promise), NOT_RUN)


def record_of(rows: Sequence[Row], figures: Figures) -> str:
    """The record as JSON: one line a row, in the order of the tests."""
    documents = [{**row._asdict(), "figure": _figure(row, figures)} for row in rows]
    return "[\n" + ",\n".join(json.dumps(one, ensure_ascii=False) for one in documents) + "\n]\n"


def whole_page(rows: Sequence[Row], figures: Figures) -> str:
    """All rows as Markdown, in the order of the tests."""
    lines = (f"| {row.fault} | {row.promise} | `{row.test}` | {_figure(row, figures)} |\n" for row in rows)
    return WHOLE_HEAD + "".join(lines)


def page_of(rows: Sequence[Row], figures: Figures, selected: Mapping[str, Sequence[Selected]] = SELECTED) -> str:
    """The page for people.

    Raises:
        ValueError: a chosen row stands for no mark, or for several.
    """
    text = PAGE_HEAD.format(count=len(rows))
    for section, choices in selected.items():
        text += f"\n## {section}\n\n| what goes wrong | what holds | test | last figure |\n|---|---|---|---|\n"
        for choice in choices:
            marked = [row for row in rows if row.fault == choice.mark and choice.held in (None, row.promise)]
            if len(marked) != 1:
                raise ValueError(f"{len(marked)} marks have the fault {choice.mark!r}: one is needed")
            (row,) = marked
            text += f"| {choice.fault} | {choice.promise} | `{row.test}` | {_figure(row, figures)} |\n"
    return text


class FaultTable:
    """The pytest plugin: gathers what marked tests measured, and writes the table after each of them: what was measured
    before a run is ended stays."""

    def __init__(self, table: Path) -> None:
        """`table`: a record to be renewed if its name ends with `.json`, else a page of all rows. With the record of
        the tests, the page for people is renewed, too."""
        self._table = table.resolve()
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
        """Rows of this run with their figures, all others with the last that is recorded."""
        is_record = self._table.suffix == ".json"
        figures = recorded_figures(self._table if is_record else RECORD)
        for row, measured in self._figures.items():
            figures[row.fault, row.promise] = "; ".join(dict.fromkeys(measured)) or HELD
        self._table.parent.mkdir(parents=True, exist_ok=True)
        text = record_of(self._rows, figures) if is_record else whole_page(self._rows, figures)
        self._table.write_text(text, encoding="utf-8")
        if self._table == RECORD:
            PAGE.write_text(page_of(self._rows, figures), encoding="utf-8")


def rows_of_item(item: pytest.Item) -> list[Row]:
    """The rows that a collected test is marked with, its own and those of its class."""
    rows: list[Row] = []
    for node, mark in item.iter_markers_with_node("fault"):
        fault, promise = mark.args
        name = node.name.partition("[")[0]
        rows.append(Row(fault, promise, f"{item.path.relative_to(TESTS.parent).as_posix()}::{name}"))
    return rows
