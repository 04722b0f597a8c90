"""Processes that judge windows: what a window does to its own is a row, and the batch goes on."""

from __future__ import annotations

import hashlib
import os
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from coec.fleet.engines import LocalEngine
from coec.fleet.evaluator import ReplaySettings
from coec.fleet.jobs import Job
from coec.fleet.worker_pool import DEADLINE, PROCESS_DIED, TOO_LARGE, Engine, WorkerLimits
from coec.io.mcap.windows import read_result
from coec.schemas.message import to_json

MIB = 2**20
CHECK_AGAIN_S = 0.01
"""Between two checks of which processes read: to check all the time takes the core that they need."""
BOUNDS = WorkerLimits(120.0, 4096 * MIB)


@pytest.fixture
def poisoned(tmp_path: Path) -> Iterator[str]:
    """A window that ends whichever process of this one's reads it: a pipe, whose writer kills the readers."""
    path = tmp_path / "poisoned.mcap"
    os.mkfifo(path)
    stop = threading.Event()

    def kill() -> None:
        while not stop.is_set():
            with path.open("wb"):  # returns when somebody reads, which may be before the reader's descriptor is listed
                readers: list[psutil.Process] = []
                while not (readers or stop.wait(CHECK_AGAIN_S)):
                    readers = [child for child in psutil.Process().children(recursive=True) if _reads(child, path)]
                for reader in readers:
                    reader.kill()

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    yield str(path)
    stop.set()
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb"):
        thread.join(10.0)


def _reads(child: psutil.Process, path: Path) -> bool:
    """psutil tells of regular files only. A child that is just being started still holds this process's end of the
    pipe, for writing."""
    try:
        files = [file for file in Path(f"/proc/{child.pid}/fd").iterdir() if file.readlink() == path]
        return any(file.lstat().st_mode & stat.S_IRUSR for file in files)
    except OSError:
        return False


def decided(engine: Engine, jobs: list[Job]) -> dict[str, str | None]:
    """Decision or code of the error, by window."""
    return {row.url: row.decided or row.error_code for row in engine.rows(jobs, ReplaySettings())}


def expected(recorded: Path) -> dict[str, str | None]:
    reported: dict[str, str | None] = {}
    for path in sorted(recorded.rglob("*.mcap")):
        result = read_result(path)
        assert result is not None
        reported[str(path)] = hashlib.sha256(to_json(result)).hexdigest()
    return reported


@pytest.mark.fault("a window ends the process that judges it", "a row with its error; the others are judged")
def test_a_poisoned_window_is_a_row_and_the_others_are_decided_as_by_the_vehicles(
    recorded: Path, poisoned: str
) -> None:
    want = expected(recorded)
    one, two = want
    reported = decided(LocalEngine(2, BOUNDS), [Job(one), Job(poisoned), Job(two)])
    assert reported == {**want, poisoned: PROCESS_DIED}


@pytest.mark.fault("a window that never ends, or takes all memory", "a row with its error, within the bounds")
def test_time_and_memory_are_bounded(recorded: Path, tmp_path: Path) -> None:
    endless = tmp_path / "endless.mcap"
    os.mkfifo(endless)  # that nobody writes
    one = next(iter(expected(recorded)))
    assert decided(LocalEngine(1, WorkerLimits(1.0, 4096 * MIB)), [Job(str(endless))]) == {str(endless): DEADLINE}
    assert decided(LocalEngine(1, WorkerLimits(120.0, MIB)), [Job(one)]) == {one: TOO_LARGE}


def test_no_windows_need_no_process() -> None:
    assert list(LocalEngine(2, BOUNDS).rows([], ReplaySettings())) == []


@pytest.mark.slow
def test_a_cluster_of_ray_decides_the_same(recorded: Path, poisoned: str) -> None:
    pytest.importorskip("ray", reason="needs the optional extra `ray`")
    from coec.fleet.engines import RayEngine

    want = expected(recorded)
    one, two = want
    engine = RayEngine(2, BOUNDS, "local")
    try:
        assert decided(engine, [Job(one), Job(poisoned), Job(two)]) == {**want, poisoned: PROCESS_DIED}
    finally:
        engine.close()
