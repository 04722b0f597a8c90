"""The worker process by itself: how soon it is ready, and how much memory a solve takes."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from coec.adapters.files.rig import intrinsics_config
from coec.adapters.mcap.windows import WindowWriter, read_window
from coec.config import (
    CalibrationConfig,
    CameraConfig,
    Config,
    LidarConfig,
    LogConfig,
    ObjectiveConfig,
    PairConfig,
    SearchConfig,
    StateConfig,
)
from coec.errors import CalibrationError
from coec.runtime.worker import jobs
from coec.runtime.worker.jobs import JobOutcome
from coec.runtime.worker.supervisor import Worker, WorkerState
from coec_lab.bench import scene
from coec_lab.bench.process import ProcessReading

CAMERA = "double_sphere"
POLL_S, TIMEOUT_S = 0.005, 300.0
"""Period of polling whether the worker has started, because nothing announces it; and the timeout, because a first
start compiles every kernel."""

SOLVES: Mapping[str, CalibrationConfig] = {
    "mi": CalibrationConfig(objective=ObjectiveConfig(kind="mi"), search=SearchConfig(dof=3)),
    "fused": CalibrationConfig(search=SearchConfig(dof=6)),
}
"""Solves whose memory is measured: the paper's objective, and the default one with six degrees of freedom."""


def measure(folder: Path, frames: int, heard: Callable[[str], None]) -> dict[str, Any]:
    """Starts a worker for each of `SOLVES` and has it do a whole window of `frames` frames: reading, depth inference,
    the solve, writing the result into the file. Another worker gets a check of the monitor at its start.

    Raises:
        CalibrationError: the worker reached no result.
    """
    document: dict[str, Any] = {}
    heard("windows for the worker")
    windows = {name: _window(folder, name, frames) for name in SOLVES}
    for name, window in windows.items():
        heard(f"the worker: {name}")
        document |= _solve(name, window, _configuration(folder, name))
    heard("the worker: first result")
    last, window = windows.popitem()
    return document | {"worker_first_result_s": _first_result_s(last, window, _configuration(folder, last))}


Outcomes = queue.SimpleQueue[JobOutcome]


@contextmanager
def _worker(config: Config) -> Iterator[Worker]:
    worker = Worker(config.worker, config.model_dump_json())
    try:
        yield worker
    finally:
        worker.request_stop()
        worker.thread.join(TIMEOUT_S)


def _solve(name: str, window: Path, config: Config) -> dict[str, Any]:
    outcomes: Outcomes = queue.SimpleQueue()
    with _worker(config) as worker:
        begin = time.perf_counter()
        worker.start()
        while (status := worker.status()).state is WorkerState.STARTING:
            if status.failure is not None:
                raise CalibrationError(f"the worker of the benchmark does not start: {status.failure.text}")
            time.sleep(POLL_S)
        ready_s = time.perf_counter() - begin
        process = ProcessReading(worker.pid or 0)
        idle_mb = process.resident_mb
        process.reset_peak()
        begin = time.perf_counter()
        worker.ask(jobs.solve(name, window, window.stem, outcomes.put))
        _await_result(outcomes)
        solve_s, peak_mb = time.perf_counter() - begin, process.peak_mb
    return {
        f"worker_ready_s_{name}": ready_s,
        f"worker_window_s_{name}": solve_s,
        f"worker_idle_mb_{name}": idle_mb,
        f"solve_memory_mb_{name}": peak_mb - idle_mb,
    }


def _first_result_s(name: str, window: Path, config: Config) -> float:
    outcomes: Outcomes = queue.SimpleQueue()
    (pair,) = config.pairs
    pairs = read_window(window)[0].pairs[: pair.monitor.pairs]
    with _worker(config) as worker:
        begin = time.perf_counter()
        check = jobs.check(name, pair.calibration, scene.T_TRUE, pairs, outcomes.put)
        worker.ask(replace(check, deadline_s=TIMEOUT_S))
        worker.start()
        _await_result(outcomes)
        return time.perf_counter() - begin


def _await_result(outcomes: Outcomes) -> None:
    """Raises:
    CalibrationError: the worker gave a reason instead.
    """
    outcome = outcomes.get(timeout=TIMEOUT_S)
    if outcome.reason is not None:
        raise CalibrationError(f"the worker could not do the work of the benchmark: {outcome.reason.text}")


def _window(folder: Path, name: str, frames: int) -> Path:
    camera = scene.CAMERAS[CAMERA]
    path = folder / f"{name}-0.mcap"
    writer = WindowWriter(path, scene.rig_of(camera), scene.T_TRUE, path.stem, SOLVES[name], {})
    for seed in range(frames):
        writer.add(scene.pair(camera, seed, seed * 1_000_000_000))
    return writer.finish().path


def _configuration(folder: Path, name: str) -> Config:
    pair = PairConfig(
        name=name,
        camera=CameraConfig(key="camera", intrinsics=intrinsics_config(scene.CAMERAS[CAMERA])),
        lidar=LidarConfig(key="lidar"),
        T_camera_lidar=scene.T_TRUE.tolist(),
        calibration=SOLVES[name],
    )
    return Config(log=LogConfig(level="error"), state=StateConfig(directory=folder), pairs=(pair,))
