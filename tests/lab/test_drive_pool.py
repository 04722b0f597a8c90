"""Many simulated drives at once: every one is made once, by processes of one core each, and a dead one is told of."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from coec.io.system import ONE_THREAD
from coec_lab.commands.drive_pool import DrivesError, finished
from lab.made_drives import died, made

PATIENCE_S = 60.0
"""Of a busy machine."""


@pytest.mark.parametrize("jobs", [1, 2, None])
def test_every_drive_ismade_once(jobs: int | None) -> None:
    assert sorted(number for number, _, _ in finished(partial(made, times=3), range(4), jobs)) == [0, 3, 6, 9]


def test_several_processes_keep_to_a_core_each() -> None:
    drives = list(finished(partial(made, times=1), range(4), 2))
    assert os.getpid() not in {pid for _, pid, _ in drives}
    assert all(threads == ONE_THREAD for _, _, threads in drives)


def test_one_drive_needs_no_process_of_its_own() -> None:
    ((_, pid, _),) = finished(partial(made, times=1), [1], 8)
    assert pid == os.getpid()


def test_nothing_to_do_is_nothing_done() -> None:
    assert list(finished(died, [], None)) == []


def test_a_process_that_dies_is_reported_with_what_to_do() -> None:
    with pytest.raises(DrivesError, match="fewer --jobs"):
        list(finished(died, range(4), 2))


KILLED = """
import sys
from pathlib import Path
from lab.made_drives import started
from coec_lab.commands.drive_pool import finished
if __name__ == "__main__":
    list(finished(started, [Path(sys.argv[1])] * 2, 2))
"""


@pytest.mark.fault("a command that draws on many cores is killed", "none of its processes goes on")
def test_of_a_command_that_is_killed_nothing_goes_on(tmp_path: Path) -> None:
    script, started = tmp_path / "killed.py", tmp_path / "begun"
    script.write_text(KILLED)
    started.mkdir()
    command = subprocess.Popen([sys.executable, script, started], env={**os.environ, "PYTHONPATH": ":".join(sys.path)})
    deadline_s = time.monotonic() + PATIENCE_S
    while len(pids := list(started.iterdir())) < 2:
        assert time.monotonic() < deadline_s, "no drive was begun"
        time.sleep(0.05)
    command.kill()
    command.wait()
    while any(Path("/proc", pid.name).exists() for pid in pids):
        assert time.monotonic() < deadline_s, "a process goes on"
        time.sleep(0.05)
