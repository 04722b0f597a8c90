"""`coec batch` on two Ray nodes, of which one is lost for good while it judges a window."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import duckdb
import psutil
import pytest

from support.fleet import RAY_MISSING, RayNodes, batch_command, recorded_windows, two_nodes

pytestmark = pytest.mark.slow

MAX_LOST_S = 60.0
"""A lost node costs at most so much, s: until all windows are judged, less the time that judging takes."""

COPIES = 8


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("windows")
    (one, *_) = sorted(recorded_windows(tmp_path_factory.mktemp("recorded")).rglob("*.mcap"))
    for index in range(COPIES):
        shutil.copy(one, folder / f"{index:02}.mcap")
    return folder


@pytest.fixture
def nodes() -> Iterator[RayNodes]:
    with two_nodes() as nodes:
        yield nodes


def frozen(nodes: RayNodes) -> Callable[[], None]:
    """The second node falls silent; the call ends its processes."""
    stopped = nodes.freeze_second()

    def end() -> None:
        for process in stopped:
            if process.is_running():
                process.kill()

    return end


def killed(nodes: RayNodes) -> Callable[[], None]:
    nodes.kill_second()
    return lambda: None


@pytest.mark.parametrize("lose", [killed, frozen])
@pytest.mark.fault(
    "a Ray node is killed, or falls silent, while it judges a window", "its windows are judged elsewhere within 60 s"
)
def test_windows_of_a_lost_node_are_judged_elsewhere_once_each(
    nodes: RayNodes, windows: Path, tmp_path: Path, lose: Callable[[RayNodes], Callable[[], None]]
) -> None:
    folder = tmp_path / "results"
    arguments = (windows, "--output", folder, "--engine", "ray", "--ray-address", nodes.address, "--json")
    with subprocess.Popen(batch_command(*arguments), stdout=subprocess.PIPE, text=True) as process:
        while not nodes.judging_on_second():
            assert process.poll() is None, "the batch ended before the second node had a window"
        clean_up = lose(nodes)
        lost_s = time.monotonic()
        try:
            out, _ = process.communicate(timeout=300.0)
        finally:
            clean_up()
    took_s = time.monotonic() - lost_s
    assert process.returncode == 0
    report = json.loads(out)
    assert (report["windows"], report["errors"], report["differing"]) == (COPIES, {}, 0)
    table = f"read_parquet('{folder}/**/*.parquet')"
    ((rows, urls, seconds),) = duckdb.sql(f"SELECT count(*), count(DISTINCT url), sum(seconds) FROM {table}").fetchall()
    assert rows == urls == COPIES
    print(f"{lose.__name__}: all judged {took_s:.1f} s after the loss; judging took {seconds:.1f} s in all")
    assert took_s - seconds <= MAX_LOST_S


def test_without_a_cluster_none_is_started(windows: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason=RAY_MISSING)
    before = {process.pid for process in psutil.process_iter()}
    environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    command = batch_command(windows, "--output", tmp_path / "results", "--engine", "ray")
    refused = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120.0, check=False)
    assert refused.returncode == 1
    for way_out in ("RAY_ADDRESS=HOST:6379", "--ray-address local", "--engine local"):
        assert way_out in refused.stderr
    assert not (tmp_path / "results").exists()
    raylets = [process for process in psutil.process_iter(["pid", "name"]) if process.info["name"] == "raylet"]
    assert not [process for process in raylets if process.pid not in before]

    started = subprocess.run([*command, "--ray-address", "local"], capture_output=True, text=True, check=False)
    assert started.returncode == 0, started.stderr
