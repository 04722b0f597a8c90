"""`coec evaluate`: one recording, one known pose, many starts around it."""

from __future__ import annotations

from dataclasses import replace

from rich.progress import Progress

from coec.adapters.files import output
from coec.cli.chosen import choices_of
from coec.cli.commands.evaluate import Options
from coec.cli.exit_codes import INTERRUPTED
from coec.config import WindowConfig
from coec.errors import CalibrationError
from coec.evaluation.experiments import Stages
from coec.evaluation.statistics import Outcome
from coec.library.evaluating import Plan, Subject, bench_of, report_of, subject_of, tried
from coec.reports import console, evaluation_page, evaluation_tables, provenance
from coec.schemas.base import to_json
from coec.schemas.evaluation import ComparisonReport, EvaluationReport
from coec.sources import windows

ALL = "all"
"""Objective that stands for `METHODS`, one after the other."""

METHODS = ("fused", "mi", "intensity")
"""This project's, the paper's, and the one before it."""


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
        subject = subject_of(
            options.source, options.frames, loaded, plan_of(options), chosen, options.camera_model, stages
        )
        document: EvaluationReport | ComparisonReport
        if options.objective == ALL:
            document = _compare(options, subject, bars, stages)
        else:
            document, _ = _evaluate(options, subject, stages)
    if options.as_json:
        console.print_json(document.model_dump(mode="json"))
    elif isinstance(document, ComparisonReport):
        evaluation_tables.show_comparison(document)
    else:
        evaluation_tables.show(document)
    # Whoever reads the figures has them, should they not be written.
    if options.output is not None:
        output.write(options.output / "report.json", to_json(document))
        evaluation_page.write(options.output, document, provenance.here())
    if document.interrupted:
        console.say("coec: interrupted: the figures are of what was finished")
    return INTERRUPTED if document.interrupted else 0


def plan_of(options: Options) -> Plan:
    """What was asked for on the command line."""
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
    """With one objective: all methods share their depth."""
    return replace(options, objective=METHODS[0]) if options.objective == ALL else options


def _compare(options: Options, subject: Subject, bars: Progress, stages: Stages) -> ComparisonReport:
    """Every method, as far as the source allows.

    Raises:
        CalibrationError: it allows none.
    """
    reports: dict[str, EvaluationReport] = {}
    outcomes: dict[str, list[Outcome]] = {}
    not_evaluated: dict[str, str] = {}
    for method in METHODS:
        folder = None if options.output is None else options.output / method
        # The monitor looks through both witnesses whatever is maximised: one table tells all.
        splits = options.detection if method == METHODS[0] else 0
        of_method = replace(options, objective=method, output=folder, detection=splits)
        heard = stages.begin(method, 1)
        try:
            reports[method], outcomes[method] = _evaluate(of_method, subject, Stages(bars, f"{method}: "))
        except CalibrationError as error:
            not_evaluated[method] = str(error)
            continue
        if folder is not None:
            output.write(folder / "report.json", to_json(reports[method]))
            evaluation_page.write(folder, reports[method], provenance.here())
        heard(1, "")
        if reports[method].interrupted:
            break
    interrupted = any(report.interrupted for report in reports.values())
    if not reports:
        raise CalibrationError("; ".join(f"{method}: {reason}" for method, reason in not_evaluated.items()))
    if options.output is not None and not interrupted:
        # matplotlib takes a second to import.
        from coec.reports import evaluation_pictures

        of_starts = evaluation_pictures.Starts(options.rotation_deg, options.translation_m, options.directions)
        evaluation_pictures.write_comparison(options.output, subject.window.window_id, of_starts, outcomes)
    return ComparisonReport(
        source=options.source,
        methods=reports,
        not_evaluated=not_evaluated,
        interrupted=interrupted,
        elapsed_s=stages.elapsed_s(),
    )


def _evaluate(options: Options, subject: Subject, stages: Stages) -> tuple[EvaluationReport, list[Outcome]]:
    """One method: its experiments, their report, and what belongs into the output folder but for the report.

    Raises:
        CalibrationError: there is no result even from the source's calibration.
    """
    plan = plan_of(options)
    bench = bench_of(subject, plan, choices_of(options))
    done = tried(subject, plan, bench, stages)
    if options.output is not None and not done.interrupted:
        # matplotlib takes a second to import.
        from coec.reports import evaluation_pictures

        of_starts = evaluation_pictures.Starts(options.rotation_deg, options.translation_m, options.directions)
        draw = stages.begin("draw", None)
        evaluation_pictures.write(options.output, bench, of_starts, done.outcomes, done.frames, done.slices, draw)
        if done.normalised:
            evaluation_pictures.write_normalised(options.output, bench.window.window_id, done.normalised)
    if options.output is not None:
        table = evaluation_tables.csv_of(bench.reference, done.outcomes)
        output.write(options.output / "starts.csv", table.encode())
    return report_of(subject, plan, bench, done, stages.elapsed_s()), done.outcomes
