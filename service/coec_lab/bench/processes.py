"""Processor time and memory of processes as Linux counts them, of the worker by itself, and of the recorder."""

import os
import queue
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coec.calibration.types import FramePair
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
from coec.io.mcap.windows import WindowWriter, read_window
from coec.io.rig_files import intrinsics_config
from coec.service.ingest.pair_stream import frame_bytes
from coec.service.worker import worker_jobs
from coec.service.worker.supervisor import Worker, WorkerState
from coec_lab.bench import scene

BYTES_PER_MB = 1e6
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_CPU_FIELD = 11
"""Index of utime in /proc/PID/stat, counted after the name of the program (proc(5)); stime follows."""

_RESET_PEAK = "5"
"""Written to /proc/PID/clear_refs, resets the peak to the memory that is resident now (proc(5))."""

CAMERA = "double_sphere"
POLL_S, TIMEOUT_S = 0.005, 300.0
"""Period of polling whether the worker has started, because nothing announces it; and the timeout, because a first
start compiles every kernel."""

SOLVES: Mapping[str, CalibrationConfig] = {
    "mi": CalibrationConfig(objective=ObjectiveConfig(kind="mi"), search=SearchConfig(dof=3)),
    "fused": CalibrationConfig(search=SearchConfig(dof=6)),
}
"""Solves whose memory is measured: the paper's objective, and the default one with six degrees of freedom."""

WRITTEN_BYTES_PER_S = 35e6
"""A camera of half a megabyte and a LiDAR of three at 10 Hz, every frame written."""

Outcomes = queue.SimpleQueue[worker_jobs.JobOutcome]


class ProcessReading:
    """Readings of a process of ours, by its id."""

    def __init__(self, pid: int) -> None:
        self._folder = Path(f"/proc/{pid}")

    @property
    def cpu_s(self) -> float:
        """Processor time of all its threads since it began, s, without other load on the machine."""
        behind_name = (self._folder / "stat").read_text().rpartition(")")[2].split()
        return (int(behind_name[_CPU_FIELD]) + int(behind_name[_CPU_FIELD + 1])) / _TICKS_PER_S

    @property
    def resident_mb(self) -> float:
        """Resident memory (RSS), MB; libraries that other processes share count in full."""
        return self._of("status", "VmRSS")

    @property
    def proportional_mb(self) -> float:
        """Resident memory with every shared page divided by its users (PSS), MB."""
        return self._of("smaps_rollup", "Pss")

    @property
    def peak_mb(self) -> float:
        """Peak resident memory (RSS) since the start or `reset_peak`, MB."""
        return self._of("status", "VmHWM")

    @property
    def children(self) -> list[int]:
        """Ids of the processes that it started."""
        return [
            int(pid) for task in (self._folder / "task").iterdir() for pid in (task / "children").read_text().split()
        ]

    def reset_peak(self) -> None:
        """Reset `peak_mb`."""
        (self._folder / "clear_refs").write_text(_RESET_PEAK)

    def _of(self, file: str, name: str) -> float:
        """An entry of a file in kB, as MB."""
        lines = (self._folder / file).read_text().splitlines()
        kilobytes = next(line.split()[1] for line in lines if line.startswith(f"{name}:"))
        return int(kilobytes) * 1024 / BYTES_PER_MB


def measure_worker(
    folder: Path,
    frames: int,
    on_step: Callable[[str], None],
    solves: Mapping[str, CalibrationConfig] = SOLVES,
    points: int = scene.POINTS,
) -> dict[str, Any]:
    """Starts a worker for each of the solves and has it do a whole window of `frames` frames: reading, depth inference,
    the solve, writing the result into the file. Another worker gets a check of the monitor at its start.

    Raises:
        CalibrationError: the worker reached no result.
    """
    document: dict[str, Any] = {}
    on_step("windows for the worker")
    windows = {name: _window(folder, name, frames, solves[name], points) for name in solves}
    for name, window in windows.items():
        on_step(f"the worker: {name}")
        document |= _solve(name, window, _configuration(folder, name, solves[name]))
    on_step("the worker: first result")
    last, window = windows.popitem()
    return document | {
        "worker_first_result_s": _first_result_s(last, window, _configuration(folder, last, solves[last]))
    }


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
        worker.submit(worker_jobs.solve(name, window, window.stem, outcomes.put))
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
        check = worker_jobs.check(name, pair.calibration, scene.T_TRUE, pairs, outcomes.put)
        worker.submit(replace(check, deadline_s=TIMEOUT_S))
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


def _window(folder: Path, name: str, frames: int, solve: CalibrationConfig, points: int) -> Path:
    camera = scene.CAMERAS[CAMERA]
    path = folder / f"{name}-0.mcap"
    writer = WindowWriter(path, scene.rig_of(camera), scene.T_TRUE, path.stem, solve, {})
    for seed in range(frames):
        writer.add(scene.pair(camera, seed, seed * 1_000_000_000, points))
    return writer.finish().path


def _configuration(folder: Path, name: str, solve: CalibrationConfig) -> Config:
    pair = PairConfig(
        name=name,
        camera=CameraConfig(key="camera", intrinsics=intrinsics_config(scene.CAMERAS[CAMERA])),
        lidar=LidarConfig(key="lidar"),
        T_camera_lidar=scene.T_TRUE.tolist(),
        calibration=solve,
    )
    return Config(log=LogConfig(level="error"), state=StateConfig(directory=folder), pairs=(pair,))


def measure_recording(
    on_step: Callable[[str], None], pairs_per_window: int = 25, windows: int = 6, points: int = scene.POINTS
) -> dict[str, float]:
    """Percent of a core that writing windows takes at `WRITTEN_BYTES_PER_S` of frames, with the default packing:
    encoding, lz4, checksums, digest, and the disk. The fastest of several windows counts."""
    on_step("writing windows")
    camera = scene.CAMERAS[CAMERA]
    rig = scene.rig_of(camera)
    pairs = [_in_millimetres(scene.pair(camera, seed, seed * 100_000_000, points)) for seed in range(pairs_per_window)]
    amount = sum(frame_bytes(frame) for pair in pairs for frame in (pair.camera, pair.lidar))
    spent_s = []
    for number in range(windows):
        with tempfile.TemporaryDirectory() as folder:
            name = f"bench-{number}"
            packed = StateConfig().packing == "lz4"
            path, start = Path(folder) / f"{name}.mcap", rig.T_camera_lidar_nominal
            begin_s = time.process_time()
            writer = WindowWriter(path, rig, start, name, CalibrationConfig(), {}, packed=packed)
            for pair in pairs:
                writer.add(pair)
            writer.finish()
            spent_s.append(time.process_time() - begin_s)
    return {"recording_cpu_percent": 100.0 * min(spent_s) * WRITTEN_BYTES_PER_S / amount}


def _in_millimetres(pair: FramePair) -> FramePair:
    """The pair with points as drivers give them, in whole millimetres, and intensities in hundredths. In data with
    noise in every bit, lz4 could compress nothing and take no time."""
    rng = np.random.default_rng(pair.stamp_ns)
    brightness = np.round(rng.random(len(pair.lidar.xyz_m)), 2).astype(np.float32)
    xyz_m = np.round(pair.lidar.xyz_m, 3).astype(np.float32)
    return replace(pair, lidar=replace(pair.lidar, xyz_m=xyz_m, intensity=brightness))
