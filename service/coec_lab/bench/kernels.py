"""Speed within one process: an evaluation of the objective next to two plain forms of equation (1), solves, and checks
of the monitor. Times are the fastest of several runs. A first run of each, which may compile, does not count.

Times are the fastest of several runs. A first run of each, which may compile, does not count.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import degrees
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.check_verdict import observe
from coec.calibration.objective.mutual_information import MutualInformation, SearchBox
from coec.calibration.pipeline import calibrate
from coec.calibration.search.local_search import box_of, maximise
from coec.calibration.types import Matrix4, Silence, Window
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, SearchConfig, WindowConfig
from coec.geometry import se3
from coec.geometry.cameras import Camera, project_point
from coec.geometry.cameras.double_sphere import DoubleSphere
from coec.geometry.compiler import njit
from coec.geometry.mutual_information import BinnedFrames, mutual_information
from coec.io.depth.depth_maps import open_depth
from coec.io.images import CachedGreys, GreyImages
from coec.io.recordings import window_cutting
from coec.reports.console import StageTimes
from coec_lab.bench import scene


def by_numpy(frames: BinnedFrames, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """MI of every frame (F,), nats, by NumPy on whole arrays. Double sphere only (Usenko 2018, equations (40) to (43)).

    Raises:
        TypeError: the camera is of another model.
    """
    camera = frames.camera
    if not isinstance(camera, DoubleSphere):
        raise TypeError(f"the plain form projects by the double sphere model only, not {type(camera).__name__}")
    mi = np.zeros(frames.frames)
    for f, (begin, end) in enumerate(pairwise(frames.first_point)):
        x, y, z = T_camera_lidar[:3, :3] @ frames.xyz_m[:, begin:end] + T_camera_lidar[:3, 3:]
        d1 = np.sqrt(x**2 + y**2 + z**2)
        shifted_z = camera.xi * d1 + z
        depth = camera.alpha * np.sqrt(x**2 + y**2 + shifted_z**2) + (1.0 - camera.alpha) * shifted_z
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        seen = (z > camera.min_cosine * d1) & (depth > 0.0)
        seen &= (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
        pixel = np.floor(v[seen] + 0.5).astype(np.int64) * camera.width + np.floor(u[seen] + 0.5).astype(np.int64)
        of_depth, of_range = frames.depth_bin[f][pixel], frames.range_bin[begin:end][seen]
        joint, _, _ = np.histogram2d(
            of_depth, of_range, bins=(frames.depth_bins, frames.range_bins),
            range=((-0.5, frames.depth_bins - 0.5), (-0.5, frames.range_bins - 0.5)),
        )  # fmt: skip
        mi[f] = _information(joint)
    return mi


def by_scalar_loop(frames: BinnedFrames, T_camera_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """MI of every frame (F,), nats, by a simple compiled loop, point by point, on one core."""
    pose = np.ascontiguousarray(T_camera_lidar, np.float64)
    joint = np.zeros((frames.frames, frames.depth_bins, frames.range_bins))
    _count(frames.camera, pose, frames.xyz_m, frames.range_bin, frames.first_point, frames.depth_bin, joint)
    return np.array([_information(of_frame) for of_frame in joint])


@njit(cache=True)
def _count(
    camera: Camera, T: NDArray[np.float64], xyz: NDArray[np.float32], range_bin: NDArray[np.unsignedinteger],
    first_point: NDArray[np.int64], depth_bin: NDArray[np.unsignedinteger], joint: NDArray[np.float64],
) -> None:  # fmt: skip
    for f in range(joint.shape[0]):
        for i in range(first_point[f], first_point[f + 1]):
            x, y, z = float(xyz[0, i]), float(xyz[1, i]), float(xyz[2, i])
            u, v, valid = project_point(
                camera,
                T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
                T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
                T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
            )
            if valid and u >= -0.5 and v >= -0.5 and u < camera.width - 0.5 and v < camera.height - 0.5:
                d = depth_bin[f, int(v + 0.5) * camera.width + int(u + 0.5)]
                if d < joint.shape[1]:
                    joint[f, d, range_bin[i]] += 1.0


def _information(joint: NDArray[np.float64]) -> float:
    """H(f^P) + H(f^D) - H(f^P, f^D) of a joint histogram, nats; 0 if it is empty."""
    if not joint.any():
        return 0.0
    p = joint / joint.sum()
    return _entropy(p.sum(axis=0)) + _entropy(p.sum(axis=1)) - _entropy(p.ravel())


def _entropy(p: NDArray[np.float64]) -> float:
    positive = p[p > 0.0]
    return float(-(positive * np.log(positive)).sum())


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
