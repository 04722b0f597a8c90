"""Speed within one process: an evaluation of the objective next to plain forms, solves, and checks of the monitor.

Times are the fastest of several runs. A first run of each, which may compile, does not count.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import degrees
from typing import Any

import numpy as np
from rich.progress import Progress

from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.check_verdict import observe
from coec.calibration.objective.mutual_information import MutualInformation, SearchBox
from coec.calibration.pipeline import calibrate
from coec.calibration.search.local_search import box_of, maximise
from coec.calibration.types import Matrix4, Silence, Window
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, SearchConfig, WindowConfig
from coec.geometry import se3
from coec.geometry.mutual_information import mutual_information
from coec.io.depth.depth_maps import open_depth
from coec.io.images import CachedGreys, GreyImages
from coec.io.recordings import window_cutting
from coec.reports.console import StageTimes
from coec_lab.bench import scene
from coec_lab.bench.reference_kernels import by_numpy, by_scalar_loop

FRAMES = 25
TURNS = 6
"""Number of turns over which runs are spread, so that other load falls on all of them."""

START_DEG = (6.0, -6.0, 5.3)
"""10.0° from the truth, about all three axes."""

FAR_START_DEG = (14.0, -16.0, 13.1)
"""25.0° from the truth."""

STREET = f"sim:seed=1&seconds={4 * FRAMES}&camera=fisheye480&camera_hz=0.25&lidar_hz=0.25&ego_hz=10&depth=yes"
"""Recording for the fused solve, which needs images: one frame every four seconds, some forty metres apart."""

NOT_OF_A_SOLVE = ("load", "prepare", "depth")
"""Stages that are not part of a solve."""

CHECK_PAIRS = 6
"""Pairs of a check: the default of the monitor."""

CHECK_DRIVE = f"seed=930001&seconds={CHECK_PAIRS + 0.5}&camera_hz=1&lidar_hz=1&ego_hz=10&lidar=64&depth=yes"
"""One pair per second, with a LiDAR of 64 beams: at least 110,000 points per sweep."""

SIDES_PX: Mapping[str, str] = {"1400": "fisheye1400", "700": "fisheye700"}
"""Cameras, by the side of their images."""

CHECK_REPEATS = 12
"""Checks of which the fastest counts, because other load on the caches only makes checks slower."""

Runs = Mapping[str, tuple[Callable[[], Any], int]]
"""What to run, by name, and how often."""


@dataclass(frozen=True, slots=True)
class Size:
    """Size of the measurement.

    Attributes:
        points: of a sweep.
        frames: of a window.
        frame_counts: numbers of frames whose evaluations are compared; the others are multiples of the first.
        repeats: runs of which the fastest counts.
        few_repeats: the same of plain forms, which take a hundred times as long, and of solves.
        street: recording for the fused solve.
    """

    points: int = scene.POINTS
    frames: int = FRAMES
    frame_counts: tuple[int, ...] = (5, 25, 50, 200)
    repeats: int = 180
    few_repeats: int = 3
    street: str = STREET


def measure(bars: Progress, size: Size) -> dict[str, Any]:
    """All figures within this process, by the names of the contract."""
    task = bars.add_task("one evaluation", total=None, note="")
    search = SearchConfig(dof=3)
    start, box = _moved(START_DEG), box_of(search)
    camera = scene.CAMERAS["double_sphere"]
    objective = scene.objective_of(camera, size.frames, start, box, size.points)
    # With a box of half a turn, no pose is out of reach, so every point of every sweep is left in.
    whole = scene.objective_of(camera, size.frames, scene.T_TRUE, SearchBox(np.pi, 0.0), size.points)
    document = _evaluations(objective, whole, size)
    bars.update(task, description="camera models, numbers of frames")
    by_frames = _by_frames(objective, size)
    document |= {
        "mi_25_frames_ms_by_model": _by_model(start, box, size),
        "mi_ms_by_frames": by_frames,
        "mi_per_frame_spread_percent": _spread_percent(by_frames),
    }
    bars.update(task, description="solves")
    times = []
    for _ in range(size.few_repeats):
        begin = time.perf_counter()
        optimum = maximise(objective, start, search, Silence())
        times.append(time.perf_counter() - begin)
    document["solve_10deg_3dof_s"] = min(times)
    document["solve_10deg_3dof_evaluations"] = optimum.evaluations
    document["solve_10deg_3dof_error_deg"] = window_cutting.rotation_error_deg(optimum.T_camera_lidar, scene.T_TRUE)
    document |= measure_checks(lambda text: bars.update(task, description=text))
    return document | measure_fused(bars, size.street, size.few_repeats)


def measure_fused(bars: Progress, street: str = STREET, repeats: int = 3) -> dict[str, Any]:
    """The figures of a fused solve with six degrees of freedom, without depth inference: its time, and the error of its
    end. The first run may compile."""
    loaded = window_cutting.load_window(street, None, WindowConfig().pairs, lambda *_: None)
    xi = np.array([*np.radians(FAR_START_DEG), 0.0, 0.0, 0.0])
    window = window_cutting.with_perturbed_start(loaded.window, xi)
    configuration = CalibrationConfig(depth=DepthConfig(model="stereo"), search=SearchConfig(dof=6, reach_deg=30.0))
    depth = open_depth(configuration.depth, LimitsConfig())
    seconds = []
    for _ in range(1 + repeats):
        times = StageTimes(bars)
        estimate = calibrate(window, depth, GreyImages(LimitsConfig()), configuration, times)
        elapsed = times.elapsed_s()
        seconds.append(elapsed["total"] - sum(elapsed.get(stage, 0.0) for stage in NOT_OF_A_SOLVE))
    error_deg = window_cutting.rotation_error_deg(estimate.optimum.T_camera_lidar, window.rig.T_camera_lidar_nominal)
    return {"solve_25deg_6dof_s": min(seconds), "solve_25deg_6dof_error_deg": error_deg}


def measure_checks(on_step: Callable[[str], None]) -> dict[str, Any]:
    """By the side of the images: the least processor time of all threads for a check at the correct pose, ms, and how
    far off the truth the check puts the mount, degrees. A check that is flagged, faint or blind gets no time, because
    it is not the one that should be measured."""
    spent: dict[str, float | None] = {}
    off_deg: dict[str, float] = {}
    for side, camera in SIDES_PX.items():
        on_step(f"a check at {side} px")
        window = window_cutting.load_window(
            f"sim:{CHECK_DRIVE}&camera={camera}", None, CHECK_PAIRS, lambda *_: None
        ).window
        spent_s, observation = _check(window)
        right = not (observation.flagged or observation.weak or observation.causes)
        spent[side] = 1e3 * spent_s if right else None
        off_deg[side] = degrees(float(np.linalg.norm(observation.offset[:3])))
    return {f"look_{side}_cpu_ms": figure for side, figure in spent.items()} | {"look_off_deg": off_deg}


def _check(window: Window) -> tuple[float, Observation]:
    """Checks as the worker does: images are decoded once per check, and nothing is retained from the one before. The
    first run on a machine compiles."""
    configuration, limits = CalibrationConfig(depth=DepthConfig(model="stereo")), LimitsConfig()
    depth, least_s = open_depth(configuration.depth, limits), float("inf")
    for _ in range(1 + CHECK_REPEATS):
        begin = time.process_time()
        observation = observe(window, depth, CachedGreys(GreyImages(limits), len(window.pairs)), configuration, None)
        least_s = min(least_s, time.process_time() - begin)
    return least_s, observation


def _evaluations(objective: MutualInformation, whole: MutualInformation, size: Size) -> dict[str, Any]:
    """One evaluation of an objective, of the same with all points, and in plain forms."""
    pose = scene.T_TRUE
    fastest = _fastest(
        {
            "kernel": (lambda: mutual_information(whole.binned, pose), size.repeats),
            "objective": (lambda: objective.evaluate(pose), size.repeats),
            "scalar": (lambda: by_scalar_loop(whole.binned, pose), size.few_repeats),
            "numpy": (lambda: by_numpy(whole.binned, pose), size.few_repeats),
        }
    )
    return {
        "points_per_frame": size.points,
        "points_visited_per_frame": int(objective.binned.first_point[-1]) // size.frames,
        "mi_25_frames_ms": 1e3 * fastest["objective"],
        "mi_25_frames_nothing_left_out_ms": 1e3 * fastest["kernel"],
        "ratio_to_numpy": fastest["numpy"] / fastest["objective"],
        "ratio_to_scalar": fastest["scalar"] / fastest["objective"],
        "kernel_ratio_to_numpy": fastest["numpy"] / fastest["kernel"],
        "kernel_ratio_to_scalar": fastest["scalar"] / fastest["kernel"],
    }


def _by_model(start: Matrix4, box: SearchBox, size: Size) -> dict[str, float]:
    objectives = {
        name: scene.objective_of(camera, size.frames, start, box, size.points) for name, camera in scene.CAMERAS.items()
    }
    runs: Runs = {
        name: (partial(objective.evaluate, scene.T_TRUE), size.repeats) for name, objective in objectives.items()
    }
    return {name: 1e3 * seconds for name, seconds in _fastest(runs).items()}


def _by_frames(objective: MutualInformation, size: Size) -> dict[str, float]:
    few = scene.first(objective.binned, size.frame_counts[0])
    many = {count: scene.repeated(few, count // size.frame_counts[0]) for count in size.frame_counts}
    runs: Runs = {
        str(count): (partial(mutual_information, frames, scene.T_TRUE), size.repeats) for count, frames in many.items()
    }
    return {count: 1e3 * seconds for count, seconds in _fastest(runs).items()}


def _spread_percent(ms_by_frames: Mapping[str, float]) -> float:
    """Largest deviation of the time per frame from its mean over all numbers of frames, %."""
    per_frame = np.array([ms / int(count) for count, ms in ms_by_frames.items()])
    return float(100.0 * np.abs(per_frame / per_frame.mean() - 1.0).max())


def _moved(rotation_deg: tuple[float, float, float]) -> Matrix4:
    return se3.perturb(scene.T_TRUE, np.array([*np.radians(rotation_deg), 0.0, 0.0, 0.0]))


def _fastest(runs: Runs) -> dict[str, float]:
    """The fewest seconds of each. Each turn has several runs of one kind in a row, as in a search, so that the data of
    a window is in the cache. A first run does not count."""
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
