"""The experiment of `coec evaluate`: one recording with a known pose is solved from many starts around it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from rich.progress import Progress

from coec.calibration_options import SolverOptions
from coec.cli.calibrate import picture_of_lens_error
from coec.config import WindowConfig
from coec.errors import CalibrationError, ExitCode
from coec.io import user_files
from coec.io.recordings import window_cutting
from coec.reports import console, page
from coec.reports.page import Block, Page
from coec.reports.page_parts import Provenance
from coec.schemas.message import to_json
from coec_lab.commands.evaluate import ALL
from coec_lab.experiments import evaluation_tables
from coec_lab.experiments.evaluation_page import comparison_page, evaluation_page, show, show_comparison
from coec_lab.experiments.evaluation_run import Plan, Subject, bench_of, report_of, subject_of, tried
from coec_lab.experiments.evaluation_schema import ComparisonReport, EvaluationReport
from coec_lab.experiments.solve_experiments import Stages
from coec_lab.experiments.solve_statistics import SolveOutcome

METHODS = ("fused", "mi", "intensity")
"""This project's objective, that of the paper, and the one before the paper."""


@dataclass(frozen=True, slots=True)
class EvaluationRequest:
    """What is evaluated: `frames` camera frames of a source (None: the usual number), with a camera model to fit (None:
    that of the source), the experiments, and how windows are calibrated."""

    source: str
    frames: int | None
    camera_model: str | None
    plan: Plan
    choices: SolverOptions


@dataclass(frozen=True, slots=True)
class Evaluated:
    """One method; `page()` makes the page of it."""

    report: EvaluationReport
    outcomes: list[SolveOutcome]
    page: Callable[[], Page]


def run(request: EvaluationRequest, folder: Path | None, *, as_json: bool) -> int:
    """Prints the report; there is no verdict on the figures.

    Raises:
        CoecError: there is nothing to evaluate.
    """
    is_comparison = request.choices.get("objective") == ALL
    if folder is not None:
        user_files.try_folder(folder)
    with console.progress() as bars:
        stages = Stages(bars)
        load = stages.begin("load", None)
        loaded = window_cutting.load_window(
            request.source, request.frames, WindowConfig().pairs, lambda done, _: load(done, "")
        )
        # What all methods share is loaded with the first.
        choices = (
            with_objective(request.choices, METHODS[0]) if request.choices.get("objective") == ALL else request.choices
        )
        with picture_of_lens_error(folder, loaded.window.rig.camera):
            subject = subject_of(
                request.source, request.frames, loaded, request.plan, choices, request.camera_model, stages
            )
        document: EvaluationReport | ComparisonReport
        if is_comparison:
            document, make_page = _compare(request, subject, folder, bars, stages)
        else:
            of_method = _evaluate(request.plan, choices, subject, folder, stages)
            document, make_page = of_method.report, of_method.page
    if as_json:
        console.print_json(document)
    elif isinstance(document, ComparisonReport):
        show_comparison(document)
    else:
        show(document)
    # Printed first, so that the figures are not lost if they cannot be written.
    if folder is not None:
        user_files.write_output(folder / "report.json", to_json(document))
        page.write(folder / "report.html", make_page())
    if document.interrupted:
        console.say("coec: interrupted: the figures are of what was finished")
    return ExitCode.INTERRUPTED if document.interrupted else 0


def with_objective(choices: SolverOptions, objective: str) -> SolverOptions:
    """The same choices with another objective."""
    return {**choices, "objective": objective}


def _compare(
    request: EvaluationRequest, subject: Subject, folder: Path | None, bars: Progress, stages: Stages
) -> tuple[ComparisonReport, Callable[[], Page]]:
    """Evaluates every method that the source allows; returns the report, and a function that makes the page of all.

    Raises:
        CalibrationError: the source allows none.
    """
    evaluated: dict[str, Evaluated] = {}
    not_evaluated: dict[str, str] = {}
    for method in METHODS:
        of_method = None if folder is None else folder / method
        # The monitor uses both cues whatever is maximised, so one table of detection is enough.
        plan = request.plan if method == METHODS[0] else replace(request.plan, detection=0)
        on_done = stages.begin(method, 1)
        try:
            evaluated[method] = _evaluate(
                plan, with_objective(request.choices, method), subject, of_method, Stages(bars, f"{method}: ")
            )
        except CalibrationError as error:
            not_evaluated[method] = str(error)
            continue
        if of_method is not None:
            user_files.write_output(of_method / "report.json", to_json(evaluated[method].report))
            page.write(of_method / "report.html", evaluated[method].page())
        on_done(1, "")
        if evaluated[method].report.interrupted:
            break
    interrupted = any(each.report.interrupted for each in evaluated.values())
    if not evaluated:
        raise CalibrationError("; ".join(f"{method}: {reason}" for method, reason in not_evaluated.items()))
    ends: tuple[Block, ...] = ()
    if folder is not None and not interrupted:
        # matplotlib takes a second to import.
        from coec_lab.experiments import evaluation_pictures

        outcomes = {method: each.outcomes for method, each in evaluated.items()}
        window_id = subject.window.window_id
        plan = request.plan
        of_starts = evaluation_pictures.Starts(plan.rotation_deg, plan.translation_m, plan.directions)
        ends = evaluation_pictures.write_comparison(folder, window_id, of_starts, outcomes)
    report = ComparisonReport(
        source=request.source,
        methods={method: each.report for method, each in evaluated.items()},
        not_evaluated=not_evaluated,
        interrupted=interrupted,
        elapsed_s=stages.elapsed_s(),
    )
    return report, lambda: comparison_page(report, ends, Provenance.here())


def _evaluate(plan: Plan, choices: SolverOptions, subject: Subject, folder: Path | None, stages: Stages) -> Evaluated:
    """Evaluates one method: runs its experiments, and writes everything but the report into the folder.

    Raises:
        CalibrationError: there is no result even from the source's calibration.
    """
    bench = bench_of(subject, plan, choices)
    done = tried(subject, plan, bench, stages)
    ends: tuple[Block, ...] = ()
    worst: tuple[Block, ...] = ()
    if folder is not None and not done.interrupted:
        # matplotlib takes a second to import.
        from coec_lab.experiments import evaluation_pictures

        of_starts = evaluation_pictures.Starts(plan.rotation_deg, plan.translation_m, plan.directions)
        on_plot = stages.begin("draw", None)
        written = evaluation_pictures.write(folder, bench, of_starts, done.outcomes, done.frames, done.slices, on_plot)
        ends, worst = written.ends, written.worst
        if done.normalised:
            evaluation_pictures.write_normalised(folder, bench.window.window_id, done.normalised)
    if folder is not None:
        table = evaluation_tables.csv_of(bench.reference, done.outcomes)
        user_files.write_output(folder / "starts.csv", table.encode())
    report = report_of(subject, plan, bench, done, stages.elapsed_s())
    return Evaluated(report, done.outcomes, lambda: evaluation_page(report, ends, worst, Provenance.here()))
