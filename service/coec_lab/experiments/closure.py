"""Do two calibrations close? Two cameras, or two LiDARs, are each calibrated by themselves and compared through the
known pose between them. The test needs no reference for either.

Two cameras A and B beside one LiDAR: T_B_A · T_A_lidar should be T_B_lidar. Two LiDARs beside one camera: T_camera_A ·
T_B_A⁻¹ should be T_camera_B. The difference is the closure error, ξ about the axes of camera B.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4, Rig
from coec.calibration_options import SolverOptions
from coec.config import LimitsConfig, WindowConfig
from coec.errors import UsageError
from coec.geometry import se3
from coec.io import user_files
from coec.io.depth.depth_maps import open_depth
from coec.io.recordings import window_cutting
from coec.reports import console
from coec.reports.page_parts import finite_degrees
from coec.schemas.message import to_json
from coec.schemas.replies import Vector6
from coec_lab.experiments import evaluation_page, solve_experiments, solve_statistics
from coec_lab.experiments.evaluation_documents import angle_spread_of, normalised_of, spread_of
from coec_lab.experiments.evaluation_run import Plan, configuration_of
from coec_lab.experiments.evaluation_schema import ClosureGroup, ClosureReport
from coec_lab.experiments.solve_experiments import Bench, Stages


class Relation(StrEnum):
    """What two rigs have in common."""

    CAMERAS = "two cameras, one LiDAR"
    LIDARS = "two LiDARs, one camera"


class FrameChoice(StrEnum):
    """On which frames both are calibrated."""

    ALL = "all frames"
    SHARED = "the same half"
    DISJOINT = "other halves"


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """The known pose between two sensors: T_b_a (4, 4) maps coordinates of sensor A to those of sensor B."""

    relation: Relation
    T_b_a: Matrix4

    def predicted(self, T_of_a: Matrix4) -> Matrix4:
        """B's calibration (4, 4) as it should be, given that of A."""
        if self.relation is Relation.CAMERAS:
            return np.asarray(self.T_b_a @ T_of_a)
        return np.asarray(T_of_a @ se3.inverse(self.T_b_a))

    @property
    def jacobian(self) -> NDArray[np.float64]:
        """(6, 6) how an error of A's calibration carries over to the prediction for B, about the axes of camera B."""
        return se3.adjoint(self.T_b_a) if self.relation is Relation.CAMERAS else np.eye(6)

    def error(
        self, a: solve_statistics.SolveOutcome, b: solve_statistics.SolveOutcome
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """ξ (6,) from what A predicts to what B found, and its covariance (6, 6) by both claims; None unless both were
        accepted and claim something."""
        of_a, of_b = solve_statistics.claimed(a), solve_statistics.claimed(b)
        if of_a is None or of_b is None:
            return None
        error = se3.difference(b.T_camera_lidar, self.predicted(a.T_camera_lidar))
        return error, of_b + solve_statistics.carried(of_a, self.jacobian)


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """How solves of A and B close, on some frames.

    Attributes:
        frames: on which both were calibrated.
        pairs: camera-LiDAR pairs in each solve of A and of B.
        normalised: the closure errors divided by what was claimed for them.
        rotation_rad, translation_m: sizes of the errors; NaN for a translation that was not searched.
    """

    frames: FrameChoice
    pairs: tuple[int, int]
    normalised: solve_statistics.NormalisedErrors
    rotation_rad: solve_statistics.SpreadStatistics
    translation_m: solve_statistics.SpreadStatistics


Solve = Callable[[int, Sequence[int] | None], solve_statistics.SolveOutcome]
"""Solves from the start of a trial, on the frames of the given indices (None: all of them)."""


def between(a: Rig, b: Rig, T_b_a: Matrix4 | None) -> Between:
    """The pose between the sensors of two rigs: T_b_a (4, 4), or what their own calibrations say.

    Raises:
        UsageError: the rigs share neither LiDAR nor camera.
    """
    if a.lidar_frame == b.lidar_frame:
        relation = Relation.CAMERAS
        recorded = b.T_camera_lidar_nominal @ se3.inverse(a.T_camera_lidar_nominal)
    elif a.camera_frame == b.camera_frame:
        relation = Relation.LIDARS
        recorded = se3.inverse(b.T_camera_lidar_nominal) @ a.T_camera_lidar_nominal
    else:
        raise UsageError(
            f"--closure: the sources share neither LiDAR ({a.lidar_frame}, {b.lidar_frame}) nor camera "
            f"({a.camera_frame}, {b.camera_frame}): give two cameras beside one LiDAR, or two LiDARs beside one camera"
        )
    return Between(relation, np.asarray(recorded) if T_b_a is None else T_b_a)


def close(
    known: Between,
    solve_a: Solve,
    solve_b: Solve,
    pairs: tuple[int, int],
    trials: int,
    dof: int,
    on_progress: Callable[[int, str], None],
) -> tuple[Closure, ...]:
    """Calibrates A and B by themselves, `trials` times from different starts: on all their frames (`pairs` of each), on
    the same half, and on halves that have no instant in common.

    Halves are drawn by index: two sources share instants if they have equal numbers of frames taken together.
    """
    outcomes_by_frames: dict[FrameChoice, list[tuple[solve_statistics.SolveOutcome, solve_statistics.SolveOutcome]]] = {
        frames: [] for frames in FrameChoice
    }
    halved = min(pairs) >= 2
    for trial in range(trials):
        outcomes_by_frames[FrameChoice.ALL].append((solve_a(trial, None), solve_b(trial, None)))
        if halved:
            one, other = solve_statistics.split(min(pairs), trial)
            a = solve_a(trial, one)
            outcomes_by_frames[FrameChoice.SHARED].append((a, solve_b(trial, one)))
            outcomes_by_frames[FrameChoice.DISJOINT].append((a, solve_b(trial, other)))
        on_progress(trial + 1, "")
    half = (min(pairs) // 2, min(pairs) // 2)
    return tuple(
        _closure(known, frames, pairs if frames is FrameChoice.ALL else half, outcomes, dof)
        for frames, outcomes in outcomes_by_frames.items()
        if outcomes
    )


def _closure(
    known: Between,
    frames: FrameChoice,
    pairs: tuple[int, int],
    outcomes: Sequence[tuple[solve_statistics.SolveOutcome, solve_statistics.SolveOutcome]],
    dof: int,
) -> Closure:
    results = [known.error(a, b) for a, b in outcomes]
    errors = [result[0] for result in results if result is not None]
    return Closure(
        frames=frames,
        pairs=pairs,
        # All trials see the same recording, so they count as one.
        normalised=solve_statistics.normalise(solve_statistics.gathered(results), independent=1),
        rotation_rad=solve_statistics.spread(float(np.linalg.norm(error[:3])) for error in errors),
        translation_m=solve_statistics.spread(float(np.linalg.norm(error[3:])) for error in errors if dof == 6),
    )


@dataclass(frozen=True, slots=True)
class ClosureRequest:
    """What is compared: recordings of sensors A and B, and the pose of A in the frame of B as text (None: that of the
    recordings). Both are calibrated alike: `frames` camera frames (None: the usual number), starts, and choices."""

    sources: tuple[str, str]
    relative: str | None
    frames: int | None
    plan: Plan
    choices: SolverOptions


def run(request: ClosureRequest, folder: Path | None, *, as_json: bool) -> int:
    """Prints the report; there is no verdict on the figures.

    Raises:
        CoecError: there is nothing to compare.
    """
    plan = request.plan
    given = None if request.relative is None else relative_of(request.relative)
    with console.progress() as bars:
        stages = Stages(bars)
        bench_a, bench_b = (
            _bench(request, source, name, stages) for source, name in zip(request.sources, "AB", strict=True)
        )
        known = between(bench_a.window.rig, bench_b.window.rig, given)
        closures = close(
            known,
            _solves(bench_a, plan),
            _solves(bench_b, plan),
            (len(bench_a.window.pairs), len(bench_b.window.pairs)),
            plan.directions,
            bench_a.configuration.search.dof,
            stages.begin("solve", plan.directions),
        )
    document = _report(request, bench_a, known, closures, stages.elapsed_s())
    if folder is not None:
        # matplotlib takes a second to import.
        from coec_lab.experiments import evaluation_pictures

        name = f"closure of {bench_a.window.window_id} and {bench_b.window.window_id}"
        of_frames = {f"closure on {closure.frames.value}": closure.normalised for closure in closures}
        evaluation_pictures.write_normalised(folder, name, of_frames)
        user_files.write_output(folder / "report.json", to_json(document))
    console.report(document, lambda: evaluation_page.show_closure(document), as_json=as_json)
    return 0


def relative_of(text: str) -> Matrix4:
    """T_b_a (4, 4) from `rx,ry,rz,tx,ty,tz`: rotation vector in degrees and translation in metres.

    Raises:
        UsageError: the text is not three or six finite numbers.
    """
    return se3.perturbation(window_cutting.parse_perturbation("--relative", text))


def _bench(request: ClosureRequest, source: str, name: str, stages: Stages) -> Bench:
    load = stages.begin(f"load {name}", None)
    loaded = window_cutting.load_window(source, request.frames, WindowConfig().pairs, lambda done, _: load(done, ""))
    configuration = configuration_of(request.plan, request.choices, loaded.configuration)
    model = open_depth(configuration.depth, LimitsConfig())
    depth = solve_experiments.inferred(loaded.window, model, stages.begin(f"depth {name}", len(loaded.window.pairs)))
    return Bench(loaded.window, depth, solve_experiments.greys_of(loaded.window), configuration)


def _solves(bench: Bench, plan: Plan) -> Solve:
    poses = solve_experiments.poses_of(bench, plan.directions, plan.rotation_deg, plan.translation_m)
    return lambda trial, frames: bench.solve(poses[trial], frames)


def _report(
    request: ClosureRequest, bench: Bench, known: Between, closures: tuple[Closure, ...], elapsed_s: dict[str, float]
) -> ClosureReport:
    offset = se3.difference(known.T_b_a, np.eye(4))
    return ClosureReport(
        source_a=request.sources[0],
        source_b=request.sources[1],
        relation=known.relation.value,
        known=cast("Vector6", finite_degrees(offset)),
        from_recordings=request.relative is None,
        objective=bench.configuration.objective.kind,
        dof=bench.configuration.search.dof,
        start_rotation_deg=request.plan.rotation_deg,
        start_translation_m=request.plan.translation_m,
        trials=request.plan.directions,
        groups=tuple(_group(closure) for closure in closures),
        elapsed_s=elapsed_s,
    )


def _group(closure: Closure) -> ClosureGroup:
    pairs_a, pairs_b = closure.pairs
    return ClosureGroup(
        frames=closure.frames.value,
        pairs_a=pairs_a,
        pairs_b=pairs_b,
        errors=normalised_of("the known pose between both", closure.normalised),
        rotation_deg=angle_spread_of(closure.rotation_rad),
        translation_m=spread_of(closure.translation_m),
    )
