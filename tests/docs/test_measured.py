"""The table of constants on the page of measurements has the values that the code has."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import pytest

from conftest import REPOSITORY

PAGE = (REPOSITORY / "docs" / "measured.md").read_text(encoding="utf-8")
ROWS = re.findall(
    r"^\| (.+) \| (.+) \| `([\w/]+\.py)` \| .+ \|$", PAGE.partition("## How constants were chosen")[2], re.MULTILINE
)


@functools.cache
def values_of(path: Path) -> dict[str, str]:
    """Sources of the values of the constants of a module, by name; names that are assigned together are joined."""
    source = path.read_text(encoding="utf-8")
    return {
        ast.unparse(target).strip("()"): " ".join((ast.get_source_segment(source, node.value) or "").split())
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign)
        for target in node.targets
    }


@pytest.mark.parametrize(("what", "value", "file"), ROWS)
def test_a_constant_has_the_value_that_the_table_says(what: str, value: str, file: str) -> None:
    path = REPOSITORY / "service" / "coec" / file
    names = ", ".join(re.findall(r"`(\w+)`", what))
    if value.startswith("`"):
        assert values_of(path)[names] == value.strip("`")
    else:
        assert path.is_file()
        assert not names.isupper() or names in values_of(path)


def test_every_constant_that_refers_to_the_page_is_in_the_table() -> None:
    files = (REPOSITORY / "service" / "coec").rglob("*.py")
    referring = {path for path in files if "See docs/measured.md." in " ".join(path.read_text("utf-8").split())}
    assert {REPOSITORY / "service" / "coec" / file for _, _, file in ROWS} - referring == {
        REPOSITORY / "service" / "coec" / "config" / "stages.py"
    }
    assert sum(path.read_text("utf-8").count("docs/measured.md") for path in referring) == len(ROWS)
