"""The page on the architecture names the files, folders and threads that there are."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from coec.io.zenoh.bus import WAITING
from conftest import REPOSITORY

PAGE = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
PACKAGE = REPOSITORY / "service" / "coec"
CODE = re.findall(r"`([^`\n]+)`", PAGE)
NOT_WRITTEN = re.compile(r"\bNAME\b|\bPAIR\b")
"""Placeholders for names that the reader chooses."""


def test_every_file_that_it_names_exists() -> None:
    named = [
        name for name in CODE if re.fullmatch(r"[\w./-]+\.(py|toml|md|svg)", name) and not NOT_WRITTEN.search(name)
    ]
    assert len(named) > 40
    assert [name for name in named if not (PACKAGE / name).is_file() and not (REPOSITORY / name).is_file()] == []


def test_every_folder_of_both_packages_has_its_line() -> None:
    for package in ("coec", "coec_lab"):
        (table,) = re.findall(rf"^\| `service/{package}` \|.*\n\|---\|---\|\n((?:\|.*\n)+)", PAGE, flags=re.MULTILINE)
        named = re.findall(r"^\| `([^`]+)` \|", table, flags=re.MULTILINE)
        root = REPOSITORY / "service" / package
        folders = {path.parent.relative_to(root).as_posix() for path in root.rglob("*.py")} - {"."}
        assert sorted(named) == sorted(folders)


def thread_names() -> Iterator[str]:
    """Names of the threads of the service, as they stand in its source, with `PAIR` for what is put in."""
    for path in (*(PACKAGE / "service").rglob("*.py"), *(PACKAGE / "io").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "ServiceThread":
                name = node.args[0]
                parts = name.values if isinstance(name, ast.JoinedStr) else [name]
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "PAIR" for part in parts)


def test_every_thread_of_the_service_is_in_the_table() -> None:
    (table,) = re.findall(r"^\| thread \|.*\n\|[-|]+\n((?:\|.*\n)+)", PAGE, flags=re.MULTILINE)
    named = re.findall(r"^\| `([^`]+)` \|", table, flags=re.MULTILINE)
    lanes = {f"{lane.value}-queries" for lane in WAITING}
    assert set(named) == {*thread_names(), "MainThread"} - {"PAIR-queries"} | lanes
