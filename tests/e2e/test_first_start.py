"""The first start on a machine: nothing is compiled yet, and frames come at once. `COEC_BUSY=10` runs ten busy loops
beside it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from coec.config import CalibrationConfig, DepthConfig, ObjectiveConfig, WindowConfig, WorkerConfig
from e2e import processes
from e2e.drives import SHORT, SHORT_PAIRS, later, rendered
from e2e.processes import Router, added_to_environment, service, write_configuration

pytestmark = pytest.mark.slow

SLICE_S = 12
WINDOW = WindowConfig(pairs=SHORT_PAIRS, min_pairs=4, slice_s=SLICE_S)
BY_DEPTH = CalibrationConfig(depth=DepthConfig(model="stereo"), objective=ObjectiveConfig(kind="mi"))


@contextmanager
def busy(loops: int) -> Iterator[None]:
    """Other processes want the cores, as much as the worker does."""
    loop = f"import os; os.nice({WorkerConfig().niceness})\nwhile True: pass"
    children = [subprocess.Popen([sys.executable, "-c", loop]) for _ in range(loops)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()


@pytest.mark.fault(
    "a first start without compiled kernels, while frames come",
    "health has the reason, no worker is replaced, the monitor is not called blind, windows are recorded and solved",
)
def test_a_first_start_says_that_it_compiles_and_loses_no_window(
    tmp_path: Path, router: Router, monkeypatch: pytest.MonkeyPatch, record_property: Any
) -> None:
    pytest.importorskip("embreex", reason="needs embreex")
    drive = rendered(SHORT)
    config = write_configuration(tmp_path, drive.recording, router.endpoint, calibration=BY_DEPTH, window=WINDOW)
    monkeypatch.setattr(processes, "PATIENCE_S", 1500.0)
    seen: set[str] = set()
    with (
        added_to_environment({"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}),
        busy(int(os.environ.get("COEC_BUSY", "0"))),
        service(config, router, warm=False) as it,
    ):

        def codes(health: Any) -> set[str]:
            """Those of the reasons of health, which are also noted."""
            result = {reason["code"] for reason in health["reasons"]}
            seen.update(result)
            return result

        def runs(status: Any) -> bool:
            codes(it.health())
            return bool(status["state"] == "running")

        it.until(it.health, lambda health: "compiling_kernels" in codes(health), "the reason")
        it.send([*drive.frames, *later(drive.frames, SLICE_S), *later(drive.frames, 2 * SLICE_S)])
        status = it.status()
        assert status["state"] == "starting"
        assert 0 <= status["worker"]["compiling"]["done"] < status["worker"]["compiling"]["total"]
        it.until(it.windows, lambda windows: len(windows) >= 2, "windows that are recorded meanwhile")
        it.until(it.status, runs, "the worker")
        it.until(it.counters, lambda pair: pair["solved"] >= 2, "the windows")
        status = it.until(it.status, lambda status: status["worker"]["compiling"] is None, "all kernels")
        codes(it.health())
        log = it.log.read_text()
    assert (status["worker"]["restarts"], status["worker"]["faults"]) == (0, {})
    assert "monitor_blind" not in seen
    assert "windows_in_vain" not in seen
    assert "compiling kernels, once on this machine" in log
    assert "is being replaced" not in log
    record_property("figure", f"{status['uptime_s']:.0f} s until everything was compiled")
