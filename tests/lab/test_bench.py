"""`coec bench` on a small scene: what it prints, and that its scene has its maximum at the truth."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress

from cli.conftest import SMALL, Coec
from coec.calibration.objective.mutual_information import SearchBox
from coec.errors import ConnectionFailedError
from coec.geometry import se3
from coec_lab.bench import daemon, kernels, processes, report, scene, sensors
from coec_lab.bench.processes import ProcessReading

PROMISED = {
    "mi_25_frames_ms", "ratio_to_numpy", "ratio_to_scalar", "solve_10deg_3dof_s", "solve_25deg_6dof_s",
}  # fmt: skip


POINTS = 4000
SIZE = kernels.Size(points=POINTS, frames=5, frame_counts=(5, 10), repeats=2, few_repeats=1, street=SMALL)


@pytest.mark.slow
def test_the_document_holds_what_is_promised() -> None:
    with Progress() as bars:
        document = kernels.measure(bars, SIZE)
    of_processes = ("worker", "solve_memory", "recording", "io", "ros", "rig", "large_rig", "query")
    assert set(document) >= PROMISED | {row.key for row in report.ROWS if not row.key.startswith(of_processes)}
    assert set(document["mi_25_frames_ms_by_model"]) == set(scene.CAMERAS)
    assert set(document["mi_ms_by_frames"]) == {"5", "10"}
    assert all(document[name] > 0 for name in PROMISED)
    assert document["solve_10deg_3dof_error_deg"] < 0.3


def test_the_command_prints_the_machine_and_every_figure(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    of_kernels = {row.key: 1.0 for row in report.ROWS}
    monkeypatch.setattr(kernels, "measure", lambda *_: dict(of_kernels))
    monkeypatch.setattr(report, "measure_processes", lambda _: {"io_per_second": {}, "required": report.required()})
    outcome = coec("bench", "--json")
    assert outcome.status == 0
    assert {"processor", "threads"} <= set(outcome.document["machine"])
    assert set(outcome.document["required"]) < set(outcome.document)
    assert "fused solve" in coec("bench").out


@pytest.mark.slow
def test_the_fused_solve_that_is_timed_ends_at_the_truth() -> None:
    """A time says nothing of a solve that has another result than it should."""
    with Progress() as bars:
        figures = kernels.measure_fused(bars, repeats=0)
    assert figures["solve_25deg_6dof_error_deg"] < report.OFF_DEG


@pytest.mark.slow
def test_a_worker_is_measured(tmp_path: Path) -> None:
    steps: list[str] = []
    solves = {"mi": processes.SOLVES["mi"]}
    document = processes.measure_worker(tmp_path, 6, steps.append, solves, points=30_000)
    assert steps
    assert min(document.values()) > 0.0
    assert set(document) == {
        "worker_first_result_s", "worker_ready_s_mi", "worker_window_s_mi", "worker_idle_mb_mi", "solve_memory_mb_mi",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("measure", "prefix"), [(daemon.measure_native, ""), (daemon.measure_ros, "ros_")])
def test_a_daemon_is_measured_under_load(tmp_path: Path, measure: Callable[..., dict[str, Any]], prefix: str) -> None:
    document = measure(tmp_path, lambda _: None, daemon.Timing(settle=1.0, measured=1.5))
    names = (prefix,) if prefix else ("io", "query")
    assert set(document) >= {row.key for row in report.ROWS if row.key.startswith(names)}
    assert document[f"{prefix}io_cpu_percent"] > 0.0
    assert document[f"{prefix}io_resident_mb"] > document[f"{prefix}io_proportional_mb"] > 0.0
    per_second = document[f"{prefix}io_per_second"]
    assert per_second.keys() >= {"cameras", "lidars"}
    # In a second and a half of a busy machine every stream may be silent; that frames came was awaited before.
    assert min(per_second.values()) >= 0.0


def test_sensors_that_send_nothing_are_not_measured(tmp_path: Path) -> None:
    silent = ("-c", "import sys; sys.stdin.read()")
    with pytest.raises(ConnectionFailedError, match="a sensor of the benchmark sent nothing"):
        daemon.measure_ros(tmp_path, lambda _: None, daemon.Timing(first_frame=1.0), silent)


def test_writing_windows_is_measured() -> None:
    document = processes.measure_recording(lambda _: None, pairs_per_window=2, windows=1, points=POINTS)
    assert set(document) == {row.key for row in report.ROWS if row.key.startswith("recording_")}
    assert document["recording_cpu_percent"] > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("form", daemon.RIG_SECONDS)
def test_the_cameras_of_a_vehicle_are_measured(tmp_path: Path, form: str) -> None:
    """A minute of it says nothing of the figures, but each is there, and pairs were checked."""
    document = daemon.measure_rigs(tmp_path, lambda _: None, {form: 20.0}, settle_s=1.0, pace=0.5)
    assert set(document) >= {row.key for row in report.ROWS if row.key.startswith(f"{form}_")}
    assert document[f"{form}_cpu_percent"] > document[f"{form}_io_cpu_percent"] > 0.0
    assert document[f"{form}_worker_s"]["check"] > 0.0
    assert document[f"{form}_done"]["checks"] > 0
    assert sum(document[f"{form}_health"].values()) == len(sensors.LOADS[form].pairs)


def test_the_table_says_what_is_not_as_required(capsys: pytest.CaptureFixture[str]) -> None:
    figures = {"io_cpu_percent": 30.0, "ratio_to_numpy": 50.0, "mi_ms_by_frames": {"5": 0.4}, "query_idle_p99_ms": None}
    figures |= {"solve_10deg_3dof_error_deg": 0.01, "solve_25deg_6dof_error_deg": 0.53}
    Console(width=140).print(report.table(figures))
    lines = {line.split("  ")[0].strip(): line for line in capsys.readouterr().out.splitlines()}
    assert "✗" in lines["I/O process under load, of one core"]
    assert "≤ 25 %" in lines["I/O process under load, of one core"]
    assert "✓" in lines["times as fast as NumPy"]
    assert "≥ 40 ×" in lines["times as fast as NumPy"]
    assert "✓" in lines["MI solve: error of its result"]
    assert "✗" in lines["fused solve: error of its result"]
    assert any("frames 5" in line and "0.40 ms" in line for line in lines.values())


def test_a_process_is_read() -> None:
    own = ProcessReading(os.getpid())
    before_s = own.cpu_s
    while own.cpu_s == before_s:
        sum(range(100_000))
    own.reset_peak()
    assert own.peak_mb >= own.resident_mb * 0.9
    assert own.resident_mb >= own.proportional_mb > 1.0
    with subprocess.Popen(["sleep", "60"]) as child:
        assert child.pid in own.children
        child.kill()


@pytest.mark.parametrize(
    "model",
    ["pinhole", *(pytest.param(model, marks=pytest.mark.slow) for model in scene.CAMERAS if model != "pinhole")],
)
def test_the_scene_is_seen_best_from_the_truth(model: str) -> None:
    box = SearchBox(np.radians(10.0), 0.0)
    objective = scene.objective_of(scene.CAMERAS[model], 2, scene.T_TRUE, box, POINTS)
    truth = objective.evaluate(scene.T_TRUE).score
    for axis in range(3):
        for degrees in (-3.0, 3.0):
            xi = np.zeros(6)
            xi[axis] = np.radians(degrees)
            assert objective.evaluate(se3.perturb(scene.T_TRUE, xi)).score < truth
