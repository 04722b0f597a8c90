"""Where windows are: files, folders and patterns, here and in stores."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from coec.errors import SourceError, UsageError
from coec.fleet.jobs import Job, fetched_window, jobs_of

DATA = b"a window"
SHA256 = hashlib.sha256(DATA).hexdigest()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a/1.mcap", "a/b/2.mcap", "a/b/2.txt", "3.mcap"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(DATA)
    return tmp_path


@pytest.fixture
def store(folder: Path) -> Iterator[str]:
    memory = fsspec.filesystem("memory")
    memory.put(str(folder), "/windows", recursive=True)
    yield "memory://windows"
    memory.rm("/windows", recursive=True)


def names(jobs: list[Job], under: str) -> list[str]:
    return [job.url.removeprefix(under).lstrip("/") for job in jobs]


ALL = ["3.mcap", "a/1.mcap", "a/b/2.mcap"]


def test_a_folder_a_pattern_and_a_file(folder: Path) -> None:
    assert names(jobs_of([str(folder)]), str(folder)) == ALL
    for pattern in ("**/*.mcap", "**.mcap"):
        assert names(jobs_of([f"{folder}/{pattern}"]), str(folder)) == ALL
    assert names(jobs_of([f"{folder}/a/*.mcap", f"{folder}/3.mcap"]), str(folder)) == ["3.mcap", "a/1.mcap"]


def test_the_same_behind_urls(store: str) -> None:
    for pattern in (store, f"{store}/**.mcap"):
        jobs = jobs_of([pattern])
        assert [job.url.rpartition("windows/")[2] for job in jobs] == ALL
    for job in jobs:
        with fetched_window(job.url) as path:
            assert path.read_bytes() == DATA
        assert not path.exists()


def test_each_window_once_and_in_order(folder: Path) -> None:
    jobs = jobs_of([f"{folder}/a", str(folder), f"{folder}/3.mcap"])
    assert names(jobs, str(folder)) == ALL


def test_what_names_no_window_is_reported(folder: Path) -> None:
    with pytest.raises(UsageError, match="names no window"):
        jobs_of([f"{folder}/none/*.mcap"])


def test_hashes_next_to_windows_are_their_statement(folder: Path, store: str) -> None:
    sums = f"{SHA256}  1.mcap\n{SHA256.upper()} *./other.mcap\nrubbish\n"
    (folder / "a" / "SHA256SUMS").write_text(sums)
    stated = {Path(job.url).name: job.sha256 for job in jobs_of([str(folder)])}
    assert stated == {"1.mcap": SHA256, "2.mcap": None, "3.mcap": None}
    fsspec.filesystem("memory").pipe("/windows/a/SHA256SUMS", sums.encode())
    stated = {Path(job.url).name: job.sha256 for job in jobs_of([store])}
    assert stated == {"1.mcap": SHA256, "2.mcap": None, "3.mcap": None}


def test_a_store_that_nobody_knows_or_that_fails_is_reported_without_a_password() -> None:
    with pytest.raises(UsageError, match="nowhere"):
        jobs_of(["nowhere://host/*.mcap"])
    with pytest.raises(SourceError, match=r"ftp://127\.0\.0\.1/") as reported:
        jobs_of(["ftp://somebody:secret@127.0.0.1:1/*.mcap"])
    assert "secret" not in str(reported.value)
