"""The pages of the documentation that are made of the code's own tables are those that the code would make now."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import coec
from coec.errors import EXIT_CODE_MEANINGS, CoecError, ExitCode
from coec.service.api.problems import PROBLEMS
from coec.service.engine.lidar_pairs import NOT_INSTALLED
from conftest import REPOSITORY
from generate.__main__ import PAGES

PACKAGE = Path(coec.__file__).parent

OF_A_JOB = {"busy", "deadline_passed", "not_recorded", "stopping", "superseded", "unanswered", "unsendable"}
"""Why one question to the worker came to nothing: counted, and no reason of health by itself."""

COMPOSED = {
    "overdue_budget",
    "overdue_worker",
    "overdue_depth",
    "overdue_pairing",
    "overdue_data",
    "monitor_blind",
    "windows_in_vain",
    "service_stuck",
}
"""Codes that are put together, or handed on, in `service/decisions`; `service_stuck` stands with the wire models."""


@pytest.mark.parametrize("name", list(PAGES))
def test_the_page_is_the_one_that_the_code_would_write(name: str) -> None:
    written = (REPOSITORY / "docs" / name).read_text(encoding="utf-8")
    assert written == PAGES[name](), "PYTHONPATH=docs:service python -m generate docs"


def all_errors(base: type[CoecError]) -> Iterator[type[CoecError]]:
    yield base
    for error in base.__subclasses__():
        yield from all_errors(error)


def test_every_way_to_end_is_in_the_table() -> None:
    codes = {error.exit_code for error in all_errors(CoecError)}
    others = {ExitCode.SUCCESS, ExitCode.FAULT, ExitCode.INTERRUPTED, ExitCode.BROKEN_PIPE}
    assert codes | others == set(EXIT_CODE_MEANINGS) == set(ExitCode)


def reasons_made() -> set[str]:
    """Codes of the reasons that the service makes itself, as they stand in its source."""
    result: set[str] = set()
    for path in (
        PACKAGE / "daemon.py",
        PACKAGE / "io/disk_writer.py",
        # Why two LiDARs are not measured is said of them, and of nothing else: `lidars` of the key `rig`.
        *(path for path in (PACKAGE / "service").rglob("*.py") if path.name != "lidar_pairs.py"),
    ):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        named = {
            target.id: node.value.value
            for node in tree.body
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            if not (isinstance(node, ast.Call) and _called(node.func) == "Reason"):
                continue
            code = node.args[0] if node.args else next(one.value for one in node.keywords if one.arg == "code")
            value = code.value if isinstance(code, ast.Constant) else named.get(getattr(code, "id", ""))
            if isinstance(value, str):
                result.add(value)
    return result


def _called(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def test_every_problem_is_in_the_table_with_what_to_do() -> None:
    made = reasons_made() - OF_A_JOB - {"internal_error"}
    assert made | COMPOSED | {NOT_INSTALLED.code} == set(PROBLEMS), (
        "a row of coec.service.api.problems for each, and none for others"
    )
    assert all(problem.meaning and problem.advice for problem in PROBLEMS.values())
