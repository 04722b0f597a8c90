"""The experiment of `coec evaluate --closure A B`: calibrates two sensors independently, and compares the results with
the pose between them."""

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from coec.calibration.types import Matrix4
from coec.calibration_options import SolverOptions
from coec.config import LimitsConfig, WindowConfig
from coec.geometry import se3
from coec.io import user_files
from coec.io.depth.depth_maps import open_depth
from coec.io.recordings import window_cutting
from coec.reports import console
from coec.reports.page_parts import finite_degrees
from coec.schemas.message import to_json
from coec.schemas.replies import Vector6
from coec_lab.experiments import evaluation_tables, solve_experiments
from coec_lab.experiments.closure import Between, Closure, Solve, between, close
from coec_lab.experiments.evaluation_documents import closure_of
from coec_lab.experiments.evaluation_run import Plan, configuration_of
from coec_lab.experiments.evaluation_schema import ClosureReport
from coec_lab.experiments.solve_experiments import Bench, Stages


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
    if as_json:
        console.print_json(document.model_dump(mode="json"))
    else:
        evaluation_tables.show_closure(document)
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
        groups=tuple(closure_of(closure) for closure in closures),
        elapsed_s=elapsed_s,
    )
