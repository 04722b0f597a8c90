"""A place for a result is tried before the work, and is as it was until there is a result."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coec.errors import OutputError
from coec.io import user_files


def test_a_folder_that_was_tried_is_as_it_was(tmp_path: Path) -> None:
    retained = tmp_path / "kept"
    retained.mkdir()
    (retained / "note").write_text("mine")
    for folder in (retained, tmp_path / "one" / "two", tmp_path):
        user_files.try_folder(folder)
    user_files.try_file(tmp_path / "three" / "rig.json")
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["kept", "kept/note"]


def test_what_was_tried_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / "one" / "two" / "result.json"
    user_files.try_file(path)
    assert user_files.write_output(path, b"{}").read_bytes() == b"{}"


def test_a_folder_below_a_file_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match=r"cannot write to .*--output"):
            user_files.try_folder(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@contextmanager
def files_of_at_most(size_bytes: int) -> Iterator[None]:
    """What a disk does that fills up while a file is written."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.fault("a disk that fills up while a picture is written", "said, and no half picture is left")
def test_half_a_file_is_not_left(tmp_path: Path) -> None:
    with files_of_at_most(1000), pytest.raises(OutputError, match="cannot write"):
        user_files.write_output(tmp_path / "picture.png", bytes(100_000))
    assert list(tmp_path.iterdir()) == []


def test_a_device_that_is_full_stays() -> None:
    with pytest.raises(OutputError, match="No space left"):
        user_files.write_output(Path("/dev/full"), b"picture")
    assert Path("/dev/full").exists()
