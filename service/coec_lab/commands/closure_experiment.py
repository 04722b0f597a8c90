"""`coec evaluate --closure A B`: calibrates two sensors by themselves, and compares them by the pose between them."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from coec.adapters.depth.maps import open_depth
from coec.adapters.files import output
from coec.calibration.types import Matrix4
from coec.cli.chosen import choices_of
from coec.cli.commands.evaluate import Options
from coec.config import LimitsConfig, WindowConfig
from coec.evaluation import experiments
from coec.evaluation.closure import Between, Closure, Solve, between, close
from coec.evaluation.experiments import Bench, Stages
from coec.geometry import se3
from coec.library.evaluating import configuration_of
from coec.reports import console, evaluation_tables
from coec.reports.evaluation_documents import closure_of, in_degrees
from coec.schemas.base import to_json
from coec.schemas.evaluation import ClosureReport
from coec.schemas.replies import Vector6
from coec.sources import windows
from coec_lab.commands import evaluate


def run(options: Options, source_a: str, source_b: str) -> int:
    """Prints the report; how good the figures are is for the reader to judge.

    Args:
        options: what both calibrations share; its `relative` is the pose of sensor A in the frame of B; None: taken
            from the recordings.
        source_a: recording of sensor A.
        source_b: recording of sensor B.

    Raises:
        CoecError: there is nothing to compare.
    """
    given = None if options.relative is None else relative_of(options.relative)
    with console.progress() as bars:
        stages = Stages(bars)
        bench_a = _bench(replace(options, source=source_a), "A", stages)
        bench_b = _bench(replace(options, source=source_b), "B", stages)
        known = between(bench_a.window.rig, bench_b.window.rig, given)
        closures = close(
            known,
            _solves(bench_a, options),
            _solves(bench_b, options),
            (len(bench_a.window.pairs), len(bench_b.window.pairs)),
            options.directions,
            bench_a.configuration.search.dof,
            stages.begin("solve", options.directions),
        )
    document = _report(options, (source_a, source_b), bench_a, known, closures, stages.elapsed_s())
    if options.output is not None:
        # matplotlib takes a second to import.
        from coec.reports import evaluation_pictures

        name = f"closure of {bench_a.window.window_id} and {bench_b.window.window_id}"
        of_frames = {f"closure on {closure.frames.value}": closure.normalised for closure in closures}
        evaluation_pictures.write_normalised(options.output, name, of_frames)
        output.write(options.output / "report.json", to_json(document))
    if options.as_json:
        console.print_json(document.model_dump(mode="json"))
    else:
        evaluation_tables.show_closure(document)
    return 0


def relative_of(text: str) -> Matrix4:
    """T_b_a (4, 4) from `rx,ry,rz,tx,ty,tz`: rotation vector in degrees and translation in metres.

    Raises:
        UsageError: the text is not three or six finite numbers.
    """
    return se3.perturbation(windows.vector_of("--relative", text))


def _bench(options: Options, name: str, stages: Stages) -> Bench:
    load = stages.begin(f"load {name}", None)
    loaded = windows.load(options.source, options.frames, WindowConfig().pairs, lambda done, _: load(done, ""))
    configuration = configuration_of(evaluate.plan_of(options), choices_of(options), loaded.configuration)
    model = open_depth(configuration.depth, LimitsConfig())
    depth = experiments.inferred(loaded.window, model, stages.begin(f"depth {name}", len(loaded.window.pairs)))
    return Bench(loaded.window, depth, experiments.greys_of(loaded.window), configuration)


def _solves(bench: Bench, options: Options) -> Solve:
    poses = experiments.poses_of(bench, options.directions, options.rotation_deg, options.translation_m)
    return lambda trial, frames: bench.solve(poses[trial], frames)


def _report(
    options: Options,
    sources: tuple[str, str],
    bench: Bench,
    known: Between,
    closures: tuple[Closure, ...],
    elapsed_s: dict[str, float],
) -> ClosureReport:
    apart = se3.difference(known.T_b_a, np.eye(4))
    return ClosureReport(
        source_a=sources[0],
        source_b=sources[1],
        relation=known.relation.value,
        known=cast("Vector6", in_degrees(apart)),
        from_recordings=options.relative is None,
        objective=bench.configuration.objective.kind,
        dof=bench.configuration.search.dof,
        start_rotation_deg=options.rotation_deg,
        start_translation_m=options.translation_m,
        trials=options.directions,
        groups=tuple(closure_of(closure) for closure in closures),
        elapsed_s=elapsed_s,
    )
