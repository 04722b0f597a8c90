"""`coec evaluate`: solves one recording with a known pose from many starts around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from rich.progress import Progress

from coec.adapters.files import output
from coec.cli.chosen import choices_of
from coec.cli.commands.evaluate import Options
from coec.cli.lens_refusal import drawn_if_refused
from coec.config import WindowConfig
from coec.errors import CalibrationError
from coec.evaluation.experiments import Stages
from coec.evaluation.statistics import Outcome
from coec.exit_codes import ExitCode
from coec.library.evaluating import Plan, Subject, bench_of, report_of, subject_of, tried
from coec.reports import console, evaluation_tables, page, provenance
from coec.reports.evaluation_page import comparison_page, evaluation_page
from coec.reports.page import Block, Page
from coec.schemas.base import to_json
from coec.schemas.evaluation import ComparisonReport, EvaluationReport
from coec.sources import windows

ALL = "all"
"""Value of the objective that means all `METHODS`, one after the other."""

METHODS = ("fused", "mi", "intensity")
"""This project's method, the paper's, and the one before the paper."""


def run(options: Options) -> int:
    """Prints the report; how good the figures are is for the reader to judge.

    Raises:
        CoecError: there is nothing to evaluate.
    """
    if options.output is not None:
        output.try_folder(options.output)
    with console.progress() as bars:
        stages = Stages(bars)
        load = stages.begin("load", None)
        loaded = windows.load(options.source, options.frames, WindowConfig().pairs, lambda done, _: load(done, ""))
        chosen = choices_of(_first_of(options))
        with drawn_if_refused(options.output, loaded.window.rig.camera):
            subject = subject_of(
                options.source, options.frames, loaded, plan_of(options), chosen, options.camera_model, stages
            )
        document: EvaluationReport | ComparisonReport
        if options.objective == ALL:
            document, told = _compare(options, subject, bars, stages)
        else:
            of_method = _evaluate(options, subject, stages)
            document, told = of_method.report, of_method.page
    if options.as_json:
        console.print_json(document.model_dump(mode="json"))
    elif isinstance(document, ComparisonReport):
        evaluation_tables.show_comparison(document)
    else:
        evaluation_tables.show(document)
    # Printed first, so that the figures are not lost if they cannot be written.
    if options.output is not None:
        output.write(options.output / "report.json", to_json(document))
        page.write(options.output / "report.html", told())
    if document.interrupted:
        console.say("coec: interrupted: the figures are of what was finished")
    return ExitCode.INTERRUPTED if document.interrupted else 0


def plan_of(options: Options) -> Plan:
    """The experiments that the command line requests."""
    return Plan(
        rotation_deg=options.rotation_deg,
        translation_m=options.translation_m,
        directions=options.directions,
        against_frames=options.against_frames,
        against_slice=options.against_slice,
        halves=options.halves,
        nees=options.nees,
        detection=options.detection,
        steps=options.steps,
    )


def _first_of(options: Options) -> Options:
    """The options with one objective, to load what all methods share."""
    return replace(options, objective=METHODS[0]) if options.objective == ALL else options


@dataclass(frozen=True, slots=True)
class Evaluated:
    """One method; `page()` makes the page of it."""

    report: EvaluationReport
    outcomes: list[Outcome]
    page: Callable[[], Page]


def _compare(
    options: Options, subject: Subject, bars: Progress, stages: Stages
) -> tuple[ComparisonReport, Callable[[], Page]]:
    """Evaluates every method that the source allows; returns the report, and a function that makes the page of all.

    Raises:
        CalibrationError: the source allows none.
    """
    found: dict[str, Evaluated] = {}
    not_evaluated: dict[str, str] = {}
    for method in METHODS:
        folder = None if options.output is None else options.output / method
        # The monitor uses both witnesses whatever is maximised, so one table of detection is enough.
        splits = options.detection if method == METHODS[0] else 0
        of_method = replace(options, objective=method, output=folder, detection=splits)
        heard = stages.begin(method, 1)
        try:
            found[method] = _evaluate(of_method, subject, Stages(bars, f"{method}: "))
        except CalibrationError as error:
            not_evaluated[method] = str(error)
            continue
        if folder is not None:
            output.write(folder / "report.json", to_json(found[method].report))
            page.write(folder / "report.html", found[method].page())
        heard(1, "")
        if found[method].report.interrupted:
            break
    interrupted = any(each.report.interrupted for each in found.values())
    if not found:
        raise CalibrationError("; ".join(f"{method}: {reason}" for method, reason in not_evaluated.items()))
    ends: tuple[Block, ...] = ()
    if options.output is not None and not interrupted:
        # matplotlib takes a second to import.
        from coec.reports import evaluation_pictures

        of_starts = evaluation_pictures.Starts(options.rotation_deg, options.translation_m, options.directions)
        outcomes = {method: each.outcomes for method, each in found.items()}
        ends = evaluation_pictures.write_comparison(options.output, subject.window.window_id, of_starts, outcomes)
    report = ComparisonReport(
        source=options.source,
        methods={method: each.report for method, each in found.items()},
        not_evaluated=not_evaluated,
        interrupted=interrupted,
        elapsed_s=stages.elapsed_s(),
    )
    return report, lambda: comparison_page(report, ends, provenance.here())


def _evaluate(options: Options, subject: Subject, stages: Stages) -> Evaluated:
    """Evaluates one method: runs its experiments, and writes everything but the report into the output folder.

    Raises:
        CalibrationError: there is no result even from the source's calibration.
    """
    plan = plan_of(options)
    bench = bench_of(subject, plan, choices_of(options))
    done = tried(subject, plan, bench, stages)
    ends: tuple[Block, ...] = ()
    worst: tuple[Block, ...] = ()
    if options.output is not None and not done.interrupted:
        # matplotlib takes a second to import.
        from coec.reports import evaluation_pictures

        of_starts = evaluation_pictures.Starts(options.rotation_deg, options.translation_m, options.directions)
        draw = stages.begin("draw", None)
        drawn = evaluation_pictures.write(
            options.output, bench, of_starts, done.outcomes, done.frames, done.slices, draw
        )
        ends, worst = drawn.ends, drawn.worst
        if done.normalised:
            evaluation_pictures.write_normalised(options.output, bench.window.window_id, done.normalised)
    if options.output is not None:
        table = evaluation_tables.csv_of(bench.reference, done.outcomes)
        output.write(options.output / "starts.csv", table.encode())
    report = report_of(subject, plan, bench, done, stages.elapsed_s())
    return Evaluated(report, done.outcomes, lambda: evaluation_page(report, ends, worst, provenance.here()))
