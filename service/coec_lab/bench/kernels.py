"""`coec bench`: measures how fast this machine is: the kernels against plain forms in the same run, the worker by
itself, and the daemon under the load of a vehicle.

Ratios compare the fastest of alternating runs in one process, so that other load on the machine cancels out as far as
possible. Processor time is that of one process alone; round trips and starts are wall-clock time.
"""

from __future__ import annotations

import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np
from rich.progress import Progress

from coec.adapters.depth.maps import open_depth
from coec.adapters.images.codec import GreyImages
from coec.calibration.calibrator import calibrate
from coec.calibration.objective.mutual_information import MutualInformation, SearchBox
from coec.calibration.ports import Silence
from coec.calibration.search.local_search import box_of, maximise
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, SearchConfig, WindowConfig
from coec.geometry import se3
from coec.geometry.mutual_information import mutual_information
from coec.geometry.plain_forms import by_numpy, by_scalar_loop
from coec.reports import console
from coec.reports.stage_times import StageTimes
from coec.simulation.source import require_extra
from coec.sources import windows
from coec_lab.bench import live, look, recording, rig, rows, scene, worker

FRAMES = 25
FRAME_COUNTS = (5, 25, 50, 200)
REPEATS, FEW_REPEATS, TURNS = 180, 3, 6
"""Runs of which the fastest counts; fewer of the plain forms, which take a hundred times as long; and the number of
turns over which runs are spread, so that other load falls on all of them."""

START_DEG = (6.0, -6.0, 5.3)
"""10.0° from the truth, about all three axes."""

FAR_START_DEG = (14.0, -16.0, 13.1)
"""25.0° from the truth."""

STREET = f"sim:seed=1&seconds={4 * FRAMES}&camera=fisheye480&camera_hz=0.25&lidar_hz=0.25&ego_hz=10&depth=yes"
"""Recording for the fused solve, which needs images: one frame every four seconds, some forty metres apart."""

APART = ("load", "prepare", "depth")
"""Stages that are not part of a solve."""


Runs = Mapping[str, tuple[Callable[[], Any], int]]
"""What to run, by name, and how often."""


def run(*, as_json: bool) -> int:
    """Measures and prints the table; always returns 0: a figure that misses its requirement is marked, but there is no
    verdict.

    Raises:
        SourceError: the library that draws the street of one of the solves is not installed.
    """
    require_extra()
    with console.progress(counted=False) as bars:
        document = measure(bars) | measure_processes(bars)
    if as_json:
        console.print_json(document)
    else:
        _show(document)
    return 0


def measure(bars: Progress) -> dict[str, Any]:
    """All figures within this process, by the names of the contract. Times are the fastest of several runs."""
    task = bars.add_task("one evaluation", total=None, note="")
    search = SearchConfig(dof=3)
    start = _moved(START_DEG)
    objective = scene.objective_of(scene.CAMERAS["double_sphere"], FRAMES, start, box_of(search))
    whole = _nothing_left_out("double_sphere")
    pose = scene.T_TRUE
    fastest = _fastest(
        {
            "kernel": (lambda: mutual_information(whole.binned, pose), REPEATS),
            "objective": (lambda: objective.evaluate(pose), REPEATS),
            "scalar": (lambda: by_scalar_loop(whole.binned, pose), FEW_REPEATS),
            "numpy": (lambda: by_numpy(whole.binned, pose), FEW_REPEATS),
        }
    )
    bars.update(task, description="camera models, numbers of frames")
    by_frames = _by_frames(objective)
    document: dict[str, Any] = {
        "machine": _machine(),
        "points_per_frame": scene.POINTS,
        "points_visited_per_frame": int(objective.binned.first_point[-1]) // FRAMES,
        "mi_25_frames_ms": 1e3 * fastest["objective"],
        "mi_25_frames_nothing_left_out_ms": 1e3 * fastest["kernel"],
        "ratio_to_numpy": fastest["numpy"] / fastest["objective"],
        "ratio_to_scalar": fastest["scalar"] / fastest["objective"],
        "kernel_ratio_to_numpy": fastest["numpy"] / fastest["kernel"],
        "kernel_ratio_to_scalar": fastest["scalar"] / fastest["kernel"],
        "mi_25_frames_ms_by_model": _by_model(start, box_of(search)),
        "mi_ms_by_frames": by_frames,
        "mi_per_frame_spread_percent": _spread_percent(by_frames),
    }
    bars.update(task, description="solves")
    times = []
    for _ in range(FEW_REPEATS):
        begin = time.perf_counter()
        found = maximise(objective, start, search, Silence())
        times.append(time.perf_counter() - begin)
    document["solve_10deg_3dof_s"] = min(times)
    document["solve_10deg_3dof_evaluations"] = found.evaluations
    document["solve_10deg_3dof_error_deg"] = windows.rotation_error_deg(found.T_camera_lidar, pose)
    document |= look.measure(lambda text: bars.update(task, description=text))
    return document | measure_fused(bars)


def measure_fused(bars: Progress) -> dict[str, Any]:
    """The figures of a fused solve with six degrees of freedom, without depth inference: its time, and the error of its
    end. The first run may compile."""
    loaded = windows.load(STREET, None, WindowConfig().pairs, lambda *_: None)
    xi = np.array([*np.radians(FAR_START_DEG), 0.0, 0.0, 0.0])
    window = windows.started_at(loaded.window, xi)
    configuration = CalibrationConfig(depth=DepthConfig(model="stereo"), search=SearchConfig(dof=6, reach_deg=30.0))
    depth = open_depth(configuration.depth, LimitsConfig())
    seconds = []
    for _ in range(1 + FEW_REPEATS):
        times = StageTimes(bars)
        estimate = calibrate(window, depth, GreyImages(LimitsConfig()), configuration, times)
        elapsed = times.elapsed_s()
        seconds.append(elapsed["total"] - sum(elapsed.get(stage, 0.0) for stage in APART))
    error_deg = windows.rotation_error_deg(estimate.optimum.T_camera_lidar, window.rig.T_camera_lidar_nominal)
    return {"solve_25deg_6dof_s": min(seconds), "solve_25deg_6dof_error_deg": error_deg}


def measure_processes(bars: Progress) -> dict[str, Any]:
    """The figures of whole processes, by their names in `rows.ROWS`: worker and daemon, one after the other.

    Raises:
        CalibrationError: the worker reached no result.
        ConnectionFailedError: the daemon did not become ready.
    """
    task = bars.add_task("processes", total=None, note="")

    def heard(text: str) -> None:
        bars.update(task, description=text)

    with tempfile.TemporaryDirectory(prefix="coec-bench-") as folder:
        document = worker.measure(Path(folder), FRAMES, heard)
    document |= recording.measure(heard)
    with tempfile.TemporaryDirectory(prefix="coec-bench-") as folder:
        document |= live.measure(Path(folder), heard)
    with tempfile.TemporaryDirectory(prefix="coec-bench-") as folder:
        document |= rig.measure(Path(folder), heard)
    return document | {"required": rows.required()}


def _by_model(start: Any, box: SearchBox) -> dict[str, float]:
    objectives = {name: scene.objective_of(camera, FRAMES, start, box) for name, camera in scene.CAMERAS.items()}
    runs: Runs = {name: (partial(objective.evaluate, scene.T_TRUE), REPEATS) for name, objective in objectives.items()}
    return {name: 1e3 * seconds for name, seconds in _fastest(runs).items()}


def _by_frames(objective: MutualInformation) -> dict[str, float]:
    five = scene.first(objective.binned, FRAME_COUNTS[0])
    many = {count: scene.repeated(five, count // FRAME_COUNTS[0]) for count in FRAME_COUNTS}
    runs: Runs = {
        str(count): (partial(mutual_information, frames, scene.T_TRUE), REPEATS) for count, frames in many.items()
    }
    return {count: 1e3 * seconds for count, seconds in _fastest(runs).items()}


def _spread_percent(ms_by_frames: Mapping[str, float]) -> float:
    """Largest deviation of the time per frame from its mean over all numbers of frames, %."""
    per_frame = np.array([ms / int(count) for count, ms in ms_by_frames.items()])
    return float(100.0 * np.abs(per_frame / per_frame.mean() - 1.0).max())


def _nothing_left_out(model: str) -> MutualInformation:
    """The objective with every point of every sweep: with a box of half a turn, no pose is out of reach."""
    return scene.objective_of(scene.CAMERAS[model], FRAMES, scene.T_TRUE, SearchBox(np.pi, 0.0))


def _moved(degrees: tuple[float, float, float]) -> Any:
    return se3.perturb(scene.T_TRUE, np.array([*np.radians(degrees), 0.0, 0.0, 0.0]))


def _fastest(runs: Runs) -> dict[str, float]:
    """The fewest seconds of each. Each turn has several runs of one kind in a row, as in a search, so that the data of
    a window is in the cache. A first run of each, which may compile, does not count."""
    for call, _ in runs.values():
        call()
    least = dict.fromkeys(runs, np.inf)
    for turn in range(TURNS):
        for name, (call, repeats) in runs.items():
            for _ in range(repeats * turn // TURNS, repeats * (turn + 1) // TURNS):
                begin = time.perf_counter()
                call()
                least[name] = min(least[name], time.perf_counter() - begin)
    return least


def _machine() -> dict[str, Any]:
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": numba.get_num_threads(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numba": numba.__version__,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _show(document: dict[str, Any]) -> None:
    machine = document["machine"]
    console.show(
        f"{machine['processor']}, {machine['threads']} threads, Python {machine['python']}, numba {machine['numba']}"
    )
    console.out.print(rows.table(document))
    came = ", ".join(f"{figure:.1f} {name}" for name, figure in document["io_per_second"].items())
    console.show(f"the load, a second: {came}")
