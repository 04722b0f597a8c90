"""Experiments on one window at a known pose: solves from many starts, on fewer frames, on slices, on halves; where the
solves start, and on which frames (the protocol of Borer et al., WACV 2024; METHOD, section 2). No random number
decides a start, so that two evaluations differ only by what they evaluate.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import gcd, pi, radians, sqrt

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from coec.calibration.commissioning import FAR_RAD
from coec.calibration.monitor.check import gather
from coec.calibration.pipeline import calibrate
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import DepthModel, ImageReader, Matrix4, Silence, Window
from coec.config import CalibrationConfig, LimitsConfig
from coec.errors import CalibrationError, DecodeError, SourceError
from coec.geometry import se3
from coec.io.depth.depth_maps import CachedDepth
from coec.io.images import CachedGreys, GreyImages
from coec_lab.experiments import solve_statistics
from coec_lab.experiments.detection import TriedCheck, try_detection
from coec_lab.experiments.evaluation_documents import frames_point, slice_point
from coec_lab.experiments.evaluation_schema import FramesPoint, SlicePoint
from coec_lab.experiments.mount_steps import MOUNT_STEPS, MountStepTrial, try_mount_steps

GOLDEN_ANGLE_RAD = pi * (3.0 - sqrt(5.0))
"""The turn between neighbours of a Fibonacci lattice (Á. González, "Measurement of areas on a sphere using Fibonacci
and latitude-longitude lattices", 2010)."""

GOLDEN_RATIO = (1.0 + sqrt(5.0)) / 2.0

COUNTS_PER_DECADE = (1, 2, 3, 5, 7)
"""Numbers of frames that are tried in every decade: steps of a factor of 1.4 to 2, about even on a logarithmic axis."""

SUBSET_SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""


def sphere_directions(count: int) -> NDArray[np.float64]:
    """(count, 3) unit vectors, evenly spread: the Fibonacci sphere about the third axis, from +1 down to -1.

    Raises:
        ValueError: `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"a sphere needs at least one direction, got {count}")
    index = np.arange(count)
    along = 1.0 - (2.0 * index + 1.0) / count
    across = np.sqrt(1.0 - along * along)
    azimuth = index * GOLDEN_ANGLE_RAD
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), along])


def translation_partners(count: int) -> NDArray[np.int64]:
    """(count,) a permutation: j = (k·i + c) mod count, with c = ⌊count/2⌋ and k the number nearest to count / golden
    ratio (the smaller of two) that is coprime to count.

    So neighbouring rotations get translations from all over the sphere, and every direction is used once.
    """
    ideal_step = count / GOLDEN_RATIO
    coprime = [k for k in range(1, max(count, 2)) if gcd(k, count) == 1]
    step = min(coprime, key=lambda k: (abs(k - ideal_step), k))
    return (step * np.arange(count, dtype=np.int64) + count // 2) % count


def perturbations(count: int, rotation_rad: float, translation_m: float) -> NDArray[np.float64]:
    """(count, 6) ξ: rotation vector R·d_i about the camera axes and translation T·d_j, where j is the partner of i."""
    sphere = sphere_directions(count)
    return np.hstack([rotation_rad * sphere, translation_m * sphere[translation_partners(count)]])


def start_poses(reference: Matrix4, count: int, rotation_rad: float, translation_m: float) -> list[Matrix4]:
    """The reference (4, 4) moved by every perturbation, on the left."""
    return [se3.perturb(reference, xi) for xi in perturbations(count, rotation_rad, translation_m)]


def frame_counts(available: int) -> list[int]:
    """1, 2, 3, 5, 7, 10, 20, 30, ... and all: ascending, none above `available`."""
    counts = {available}
    decade = 1
    while decade <= available:
        counts.update(decade * step for step in COUNTS_PER_DECADE if decade * step <= available)
        decade *= 10
    return sorted(counts)


def frame_subset(available: int, size: int, trial: int) -> list[int]:
    """`wanted` of `available` indices, ascending, drawn without repetition. `wanted` and `trial` seed the draw, so that
    trials differ and evaluations repeat."""
    sampled = np.random.default_rng([SUBSET_SEED, size, trial]).choice(available, size=size, replace=False)
    return sorted(int(index) for index in sampled)


SUBSETS = 20
"""Solves for every number of frames and for every length of a slice, each from another start."""

SLICE_SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Lengths of the slices as shares of the recording: even on a logarithmic axis."""

SLICES = 5
"""Most places in a recording from which slices of one length are taken; they do not overlap."""

CHECKS = 10
"""Checks per split and move at which detection is tried, unless told otherwise."""


class Stages:
    """A progress bar per stage, and the seconds that each took."""

    def __init__(self, bars: Progress, prefix: str = "") -> None:
        """`prefix` stands before the names of the stages on the bars, not in `elapsed_s`."""
        self._bars = bars
        self._prefix = prefix
        self._began_s = self._mark_s = time.perf_counter()
        self._elapsed_s: dict[str, float] = {}

    def begin(self, stage: str, total: int | None) -> Callable[[int, str], None]:
        """Begins a stage; returns a function to call with the number of parts done and a note."""
        task = self._bars.add_task(self._prefix + stage, total=total, note="")

        def on_progress(done: int, note: str = "") -> None:
            now_s = time.perf_counter()
            self._elapsed_s[stage] = self._elapsed_s.get(stage, 0.0) + now_s - self._mark_s
            self._mark_s = now_s
            self._bars.update(task, completed=done, note=note)

        return on_progress

    def elapsed_s(self) -> dict[str, float]:
        """Seconds by stage, and in `total`."""
        return {**self._elapsed_s, "total": time.perf_counter() - self._began_s}


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """What every solve of an evaluation shares; depth is inferred already."""

    window: Window
    depth: DepthModel
    images: ImageReader
    configuration: CalibrationConfig

    @property
    def reference(self) -> Matrix4:
        """The source's calibration, (4, 4)."""
        return self.window.rig.T_camera_lidar_nominal

    def solve(self, start: Matrix4, frames: Sequence[int] | None = None) -> solve_statistics.SolveOutcome:
        """Solves from one start, which is taken as a guess, on all frames or on those with the given indices."""
        pairs = self.window.pairs if frames is None else tuple(self.window.pairs[index] for index in frames)
        window = replace(self.window, T_camera_lidar_start=start, start_known_to_rad=pi, pairs=pairs)
        began_s = time.perf_counter()
        try:
            estimate = calibrate(window, self.depth, self.images, self.configuration, Silence())
        except CalibrationError:
            estimate = None
        trial = solve_statistics.Trial(start, estimate, time.perf_counter() - began_s)
        return solve_statistics.score(trial, self.reference, self.configuration.search.dof)


def inferred(window: Window, model: DepthModel, on_progress: Callable[[int, str], None]) -> DepthModel:
    """A model that holds the depth of every frame, inferred once for all solves.

    Raises:
        CalibrationError: a frame has no depth.
    """
    depth = CachedDepth(model, len(window.pairs))
    for done, pair in enumerate(window.pairs, start=1):
        try:
            depth.infer(pair.camera)
        except DecodeError as error:
            raise CalibrationError(f"no depth for the camera frame at {pair.stamp_ns} ns: {error}") from error
        on_progress(done, "")
    return depth


def greys_of(window: Window) -> ImageReader:
    """The images of a window, decoded once for all solves."""
    return CachedGreys(GreyImages(LimitsConfig()), len(window.pairs) + len(window.between))


def from_reference(bench: Bench, stages: Stages) -> solve_statistics.SolveOutcome:
    """The solve that starts at the reference, the best of all starts. It also compiles the kernels, so that the other
    solves are timed without compiling.

    Raises:
        CalibrationError: no start would give an estimate.
    """
    on_progress = stages.begin("reference", 1)
    window = replace(bench.window, T_camera_lidar_start=bench.reference)
    calibrate(window, bench.depth, bench.images, bench.configuration, Silence())
    outcome = bench.solve(bench.reference)
    on_progress(1, "")
    return outcome


def from_starts(bench: Bench, poses: Sequence[Matrix4], stages: Stages) -> Iterator[solve_statistics.SolveOutcome]:
    """One solve from each of the poses (4, 4), yielded as soon as it is done."""
    on_progress = stages.begin("starts", len(poses))
    hits = 0
    for done, pose in enumerate(poses, start=1):
        outcome = bench.solve(pose)
        hits += outcome.hit
        on_progress(done, f"{hits} hits, {100 * hits / done:.1f} %")
        yield outcome


def against_frames(bench: Bench, poses: Sequence[Matrix4], stages: Stages) -> tuple[FramesPoint, ...]:
    """Solves with different numbers of frames. Every number gets the same starts, spread over all `poses`, so that only
    the numbers of frames are compared."""
    available = len(bench.window.pairs)
    counts = frame_counts(available)
    on_progress = stages.begin("frames", len(counts) * SUBSETS)
    points = []
    for row, frames in enumerate(counts):
        outcomes = []
        for trial in range(SUBSETS):
            outcomes.append(bench.solve(_spread(poses, trial), frame_subset(available, frames, trial)))
            on_progress(row * SUBSETS + trial + 1, f"{frames} of {available}")
        points.append(frames_point(frames, outcomes))
    return tuple(points)


def against_slice(
    bench: Bench,
    model: DepthModel,
    cut: Callable[[float, float], Window],
    poses: Sequence[Matrix4],
    stages: Stages,
) -> tuple[SlicePoint, ...]:
    """Solves on slices of several lengths. Every length gets the same starts, divided among slices at several places of
    the recording, the first at its beginning.

    Args:
        bench: on the whole recording, from which slices are cut.
        model: infers the depth of frames that the bench does not hold.
        cut: the window of the frames between two times, seconds after the first frame.
        poses: starts, (4, 4).
        stages: hears of every solve.
    """
    pairs = bench.window.pairs
    whole_s = (pairs[-1].stamp_ns - pairs[0].stamp_ns) * 1e-9
    on_progress = stages.begin("slices", len(SLICE_SHARES) * SUBSETS)
    points = []
    for row, share in enumerate(SLICE_SHARES):
        length_s = share * whole_s
        slices = []
        for begin_s in _slice_begins(length_s, whole_s):
            try:
                window = cut(begin_s, begin_s + length_s)
            except SourceError:
                # A slice without a camera frame is no window.
                continue
            slices.append(window)
        outcomes: list[tuple[int, list[solve_statistics.SolveOutcome]]] = []
        for place, window in enumerate(slices):
            of_slice = replace(
                bench, window=window, depth=inferred(window, model, lambda *_: None), images=greys_of(window)
            )
            trials = range(place, SUBSETS, len(slices))
            solved = []
            for trial in trials:
                solved.append(of_slice.solve(_spread(poses, trial)))
                done = sum(len(of_place) for _, of_place in outcomes) + len(solved)
                on_progress(row * SUBSETS + done, f"{length_s:.1f} s")
            outcomes.append((len(window.pairs), solved))
        if outcomes:
            points.append(slice_point(length_s, outcomes))
    return tuple(points)


def in_halves(
    bench: Bench, splits: int, rotation_rad: float, translation_m: float, stages: Stages
) -> list[tuple[solve_statistics.SolveOutcome, solve_statistics.SolveOutcome]]:
    """Solves disjoint halves of the frames, each from another start, this far from the reference."""
    available = len(bench.window.pairs)
    poses = start_poses(bench.reference, 2 * splits, rotation_rad, translation_m)
    on_progress = stages.begin("halves", splits)
    outcomes = []
    for trial in range(splits):
        one, other = solve_statistics.split(available, trial)
        outcomes.append((bench.solve(poses[2 * trial], one), bench.solve(poses[2 * trial + 1], other)))
        on_progress(trial + 1, "")
    return outcomes


def in_windows(
    bench: Bench,
    model: DepthModel,
    cut: Callable[[float, float], Window],
    poses: Sequence[Matrix4],
    true_pose: Callable[[int], Matrix4],
    stages: Stages,
) -> list[solve_statistics.SolveOutcome]:
    """Cuts the recording into as many consecutive windows as there are starts; they share no frame. Each is solved from
    its start and compared with `true_pose` at the time of its last pair (ns). Windows without a camera frame are left
    out.

    Args:
        bench, model, cut: as for `against_slice`.
        poses: starts, (4, 4).
        true_pose: T_camera_lidar (4, 4) at a sensor time.
        stages: hears of every window.
    """
    stamps_ns = [pair.stamp_ns for pair in bench.window.pairs]
    # A microsecond more, so that the last frame belongs to the last window.
    length_s = ((stamps_ns[-1] - stamps_ns[0]) * 1e-9 + 1e-6) / len(poses)
    on_progress = stages.begin("windows", len(poses))
    outcomes = []
    for index, pose in enumerate(poses):
        on_progress(index, "")
        try:
            # Ends a nanosecond before the next window begins.
            window = cut(index * length_s, (index + 1) * length_s - 1e-9)
        except SourceError:
            continue
        depth = inferred(window, model, lambda *_: None)
        solved = replace(bench, window=window, depth=depth, images=greys_of(window)).solve(pose)
        outcomes.append(
            solve_statistics.score(solved.trial, true_pose(window.stamp_ns), bench.configuration.search.dof)
        )
    on_progress(len(poses), "")
    return outcomes


def detected(bench: Bench, splits: int, checks: int, stages: Stages) -> list[TriedCheck]:
    """How well the monitor detects a wrong extrinsic: limits are learned on some pairs, and `checks` checks per split
    and move are made on the others."""
    decode, on_progress = stages.begin("checks", None), stages.begin("detection", splits)
    window = replace(bench.window, T_camera_lidar_start=bench.reference)
    evidence = gather(prepare_window_data(window, bench.depth, bench.images, bench.configuration, Silence()), FAR_RAD)
    decode(1, "")
    return try_detection(
        evidence, bench.reference, bench.configuration, splits, checks, lambda done, _: on_progress(done, "")
    )


def mount_step_trials(bench: Bench, trials: int, stages: Stages) -> list[MountStepTrial]:
    """What calibrations say about the recording with knocks applied to it, `trials` times each kind."""
    total = 1 + trials * sum(knock.moves for knock in MOUNT_STEPS)
    on_progress = stages.begin("steps", total)
    window = replace(bench.window, T_camera_lidar_start=bench.reference)
    return try_mount_steps(
        window, bench.depth, bench.images, bench.configuration, trials, MOUNT_STEPS, lambda done: on_progress(done, "")
    )


def poses_of(bench: Bench, directions: int, rotation_deg: float, translation_m: float) -> list[Matrix4]:
    """The starts of the protocol about the reference, (4, 4) each."""
    return start_poses(bench.reference, directions, radians(rotation_deg), translation_m)


def _spread(poses: Sequence[Matrix4], trial: int) -> Matrix4:
    return poses[trial * len(poses) // SUBSETS]


def _slice_begins(length_s: float, whole_s: float) -> list[float]:
    """Where slices of a length begin, seconds: at the beginning, then evenly up to the last that does not overlap."""
    # 1e-9 of tolerance, so that a slice as long as the recording fits once.
    fits = int(whole_s / length_s + 1e-9) if length_s > 0 else 1
    indices = {round(index * (fits - 1) / max(min(fits, SLICES) - 1, 1)) for index in range(min(fits, SLICES))}
    return [index * length_s for index in sorted(indices)]
