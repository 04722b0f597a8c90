"""A recorder that is killed again and again while it writes: what was said to be on the disk is there, to the bit."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from coec.io.mcap.windows import read_window
from coec.io.recordings.bag import open_bag
from coec.io.recordings.recording_source import parse_spec
from conftest import REPOSITORY
from support.fake_worker import wait_until
from support.recording_child import PAIRS, recorder_of, stores

LONGEST_S = 0.4
"""From the first word to the kill: some windows, and the one under way."""

DEADLINE_S = 60.0


def killed(folder: Path, life: int, after_s: float) -> list[str]:
    """What a recorder said until it was killed, so long after its first word."""
    path = os.pathsep.join(str(REPOSITORY / name) for name in ("service", "tests"))
    command = [sys.executable, "-m", "support.recording_child", str(folder), str(life)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": path}) as child:
        assert child.stdout is not None
        first = child.stdout.readline()
        with suppress(subprocess.TimeoutExpired):
            child.wait(after_s)
        child.kill()
        reported = first + child.stdout.read()
    return [line for line in reported.decode().splitlines() if line.count(" ") == 2]


@pytest.mark.fault(
    "kill -9 at any moment while windows and snippets are written",
    "all that was said to be on the disk is there to the bit, and what was cut off is salvaged",
)
@pytest.mark.parametrize(("kills", "seed"), [(2, 1), pytest.param(50, 2, marks=pytest.mark.slow)])
def test_a_killed_recorder_has_all_that_it_reported(
    tmp_path: Path, kills: int, seed: int, record_property: Callable[[str, object], None]
) -> None:
    rng = np.random.default_rng(seed)
    salvaged = report = 0
    for life in range(kills):
        reported = dict(line.split()[1:] for line in killed(tmp_path, life, LONGEST_S * rng.random()))
        report += len(reported)
        windows, snippets = stores(tmp_path)
        before = {path.stem for path in windows.windows("front")}
        recording, _, _, losses = recorder_of(windows, snippets, [])
        recording.thread.start()
        wait_until(lambda: not windows.unread("front"), "the digests")  # noqa: B023 - called at once
        recording.request_stop()
        assert recording.thread.join(DEADLINE_S)
        assert recording.thread.failure is None
        assert not list(tmp_path.rglob("*.part"))
        assert set(losses.snapshot()) <= {("window", "too_few_pairs_salvaged")}
        listed = {info.window_id: str(info.sha256) for info in windows.listing("front")}
        listed |= {one.snippet_id: one.sha256 for one in snippets.listing("front")}
        for name, sha256 in reported.items():
            assert listed[name] == sha256
        for name in listed.keys() - reported.keys():
            salvaged += name not in before
        for name, sha256 in listed.items():
            path = (snippets if name.endswith(".snippet") else windows).path(name)
            assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256
            if name.endswith(".snippet"):
                assert len(open_bag(parse_spec(str(path))).camera_stamps_ns) > 0
            else:
                assert 2 <= len(read_window(path)[0].pairs) <= PAIRS
            path.unlink()
            path.with_name(f"{name}.json").unlink(missing_ok=True)
    record_property("figure", f"{kills} kills, {report} recordings told, {salvaged} salvaged")
    assert report >= kills
