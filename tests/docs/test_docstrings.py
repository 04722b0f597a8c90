"""Docstrings name the arguments and attributes that are there."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from conftest import REPOSITORY

ENTRY = re.compile(r"    (\*{0,2}\w+(?:, \*{0,2}\w+)*): ")
"""`name: ...` or `name, other: ...` in a section of a docstring."""

Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def entries(docstring: str, section: str) -> Iterator[str]:
    """The names in a section of a docstring."""
    _, _, after = docstring.partition(f"{section}:\n")
    for line in after.splitlines():
        if line and not line.startswith(" "):
            return
        if entry := ENTRY.match(line):
            yield from (name.strip("* ") for name in entry[1].split(","))


def arguments_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    return {node.arg for node in ast.walk(function.args) if isinstance(node, ast.arg)}


def attributes_of(declared: ast.ClassDef) -> set[str]:
    """Fields, methods, and what a method sets."""
    names = {node.name for node in declared.body if isinstance(node, ast.FunctionDef)}
    for node in ast.walk(declared):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
    return names


def unknown(node: Documented) -> list[str]:
    docstring = ast.get_docstring(node) or ""
    if isinstance(node, ast.ClassDef):
        return [name for name in entries(docstring, "Attributes") if name not in attributes_of(node)]
    return [name for name in entries(docstring, "Args") if name not in arguments_of(node)]


@pytest.mark.parametrize("package", ["service", "tests", "docs/generate"])
def test_docstrings_name_the_arguments_and_attributes_that_are_there(package: str) -> None:
    paths = sorted((REPOSITORY / package).rglob("*.py"))
    assert paths
    sources = {path: path.read_text(encoding="utf-8") for path in paths}
    stale = {
        f"{path.relative_to(REPOSITORY)}: {node.name}: {name}"
        for path, source in sources.items()
        if "Args:" in source or "Attributes:" in source  # to parse the others takes most of the time
        for node in ast.walk(ast.parse(source))
        if isinstance(node, Documented)
        for name in unknown(node)
    }
    assert not stale


def test_an_argument_of_another_name_is_reported() -> None:
    text = 'def f(a, *rest):\n    """Sum.\n\n    Args:\n        a: one.\n        b, rest: others.\n    """'
    (function,) = ast.parse(text).body
    assert isinstance(function, ast.FunctionDef)
    assert unknown(function) == ["b"]
