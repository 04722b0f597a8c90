"""A place for a result is tried before the work, and is as it was until there is a result."""

from __future__ import annotations

from pathlib import Path

import pytest

from coec.adapters.files import output
from coec.errors import OutputError


def test_a_folder_that_was_tried_is_as_it_was(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "note").write_text("mine")
    for folder in (kept, tmp_path / "one" / "two", tmp_path):
        output.try_folder(folder)
    output.try_file(tmp_path / "three" / "rig.json")
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["kept", "kept/note"]


def test_what_was_tried_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / "one" / "two" / "result.json"
    output.try_file(path)
    assert output.write(path, b"{}").read_bytes() == b"{}"


def test_a_folder_below_a_file_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match=r"cannot write to .*--output"):
            output.try_folder(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
