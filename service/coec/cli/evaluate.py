"""`coec evaluate`: one recording, one known pose, many starts around it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import degrees, radians
from typing import Any, cast

from pydantic import ValidationError
from rich.progress import Progress

from coec.adapters.depth.maps import open_depth
from coec.adapters.files import output
from coec.calibration.ports import DepthModel
from coec.calibration.types import Matrix4, Window
from coec.cli import calibrate as calibrate_command
from coec.cli.commands import calibrate
from coec.cli.commands.evaluate import Options
from coec.cli.exit_codes import INTERRUPTED
from coec.config import CalibrationConfig, LimitsConfig, WindowConfig, describe
from coec.errors import CalibrationError, UsageError
from coec.evaluation import experiments, normalised_errors, split_halves, statistics
from coec.evaluation.detection import require_enough
from coec.evaluation.experiments import Bench, Stages
from coec.evaluation.normalised_errors import NormalisedErrors
from coec.evaluation.split_halves import Halves
from coec.evaluation.statistics import FramesPoint, Outcome, SlicePoint
from coec.geometry.cameras import name_of
from coec.reports import console, evaluation_tables
from coec.reports.evaluation_documents import (
    angle_spread_of,
    detection_of,
    frames_point_of,
    halves_of,
    in_degrees,
    normalised_of,
    slice_point_of,
    spread_of,
    steps_of,
    verdicts_of,
)
from coec.schemas.base import to_json
from coec.schemas.evaluation import ComparisonReport, DetectionReport, EvaluationReport, StepRow
from coec.schemas.replies import Vector6
from coec.sources import open_source, windows
from coec.sources.between import with_between
from coec.sources.recording import KnowsTruth

MARGIN_DEG, MARGIN_M = 5.0, 0.2
REACH_MARGIN_DEG, REACH_MARGIN_M = 3.0, 0.15
"""How far the search box reaches beyond the starts at least, so that the reference never lies on its bound and a search
may overshoot."""

ALL = "all"
"""Objective that stands for `METHODS`, one after the other."""

SIMULATED_TRUTH, OWN_CALIBRATION = "the simulated truth", "the source's own calibration"
OTHER_HALF = "the other half of the frames"
"""What normalised errors are counted from."""

METHODS = ("fused", "mi", "intensity")
"""This project's, the paper's, and the one before it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Subject:
    """What is evaluated: the window and its depth (`model` infers that of other frames, `depth` remembers)."""

    window: Window
    model: DepthModel
    depth: DepthModel
    recorded: CalibrationConfig | None
    vehicle: str


@dataclass(slots=True, eq=False)
class _Experiments:
    """What has come of the experiments that were asked for. `interrupted`: not of all of them."""

    from_reference: Outcome
    outcomes: list[Outcome] = field(default_factory=list)
    frames: tuple[FramesPoint, ...] = ()
    slices: tuple[SlicePoint, ...] = ()
    halves: Halves | None = None
    normalised: dict[str, NormalisedErrors] = field(default_factory=dict)
    detection: DetectionReport | None = None
    steps: tuple[StepRow, ...] = ()
    interrupted: bool = False


def run(options: Options) -> int:
    """Prints the report; how good the figures are is for the reader to judge.

    Raises:
        CoecError: there is nothing to evaluate.
    """
    if options.output is not None:
        output.try_folder(options.output)
    with console.progress() as bars:
        stages = Stages(bars)
        subject = _subject(options, stages)
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
    if options.output is not None:
        output.write(options.output / "report.json", to_json(document))
    if document.interrupted:
        console.say("coec: interrupted: the figures are of what was finished")
    return INTERRUPTED if document.interrupted else 0


def configuration_of(options: Options, recorded: CalibrationConfig | None) -> CalibrationConfig:
    """As for `coec calibrate`, with a search box that holds the starts; a translated start is searched in six degrees
    of freedom unless told otherwise.

    Raises:
        UsageError: a value that does not exist, or starts too far for any search box.
    """
    configuration = calibrate_command.configuration_of(
        calibrate.Options(
            source=options.source,
            depth=options.depth,
            objective=options.objective,
            dof="6" if options.dof is None and options.translation_m > 0 else options.dof,
            no_motion_compensation=options.no_motion_compensation,
        ),
        recorded,
    )
    values: dict[str, Any] = configuration.model_dump()
    search = values["search"]
    search["rotation_deg"] = max(search["rotation_deg"], options.rotation_deg + MARGIN_DEG)
    search["translation_m"] = max(search["translation_m"], options.translation_m + MARGIN_M)
    # The protocol tells how far away the starts are; the global stage looks no further.
    search["reach_deg"] = options.rotation_deg + REACH_MARGIN_DEG
    search["reach_m"] = options.translation_m + REACH_MARGIN_M
    try:
        return CalibrationConfig.model_validate(values)
    except ValidationError as error:
        raise UsageError(
            f"the search box must reach {MARGIN_DEG:g} deg and {MARGIN_M:g} m beyond the starts: {describe(error)}"
        ) from error


def _subject(options: Options, stages: Stages) -> _Subject:
    """The recording with its depth. What it is too short for is refused before anything is inferred.

    Raises:
        CalibrationError: detection is asked for and the pairs are too few, or a frame has no depth.
    """
    load = stages.begin("load", None)
    loaded = windows.load(options.source, options.frames, WindowConfig().pairs, lambda done, _: load(done, ""))
    window = loaded.window
    if options.detection:
        require_enough(len(window.pairs))
    if options.camera_model is not None:
        window, _ = calibrate_command.refitted(window, options.camera_model)
    if options.steps and loaded.configuration is None:  # a recorded window has what was recorded
        window = with_between(window, open_source(options.source), WindowConfig())
    model = open_depth(configuration_of(_first_of(options), loaded.configuration).depth, LimitsConfig())
    depth = experiments.inferred(window, model, stages.begin("depth", len(window.pairs)))
    return _Subject(window, model, depth, loaded.configuration, loaded.vehicle)


def _first_of(options: Options) -> Options:
    """With one objective: all methods share their depth."""
    return replace(options, objective=METHODS[0]) if options.objective == ALL else options


def _compare(options: Options, subject: _Subject, bars: Progress, stages: Stages) -> ComparisonReport:
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


def _evaluate(options: Options, subject: _Subject, stages: Stages) -> tuple[EvaluationReport, list[Outcome]]:
    """One method: its experiments, their report, and what belongs into the output folder but for the report.

    Raises:
        CalibrationError: there is no result even from the source's calibration.
    """
    configuration = configuration_of(options, subject.recorded)
    bench = Bench(subject.window, subject.depth, experiments.greys_of(subject.window), configuration)
    done = _experiments(options, subject, bench, stages)
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
    return _report(options, bench, subject.vehicle, done, stages.elapsed_s()), done.outcomes


def _experiments(options: Options, subject: _Subject, bench: Bench, stages: Stages) -> _Experiments:
    """All that were asked for, or after Ctrl-C those that were finished, if at least one start was."""
    poses = experiments.poses_of(bench, options.directions, options.rotation_deg, options.translation_m)
    done = _Experiments(experiments.from_reference(bench, stages))
    try:
        for outcome in experiments.from_starts(bench, poses, stages):
            done.outcomes.append(outcome)
        _add_further(done, options, subject, bench, poses, stages)
    except KeyboardInterrupt:
        if not done.outcomes:
            raise
        done.interrupted = True
    return done


def _add_further(
    done: _Experiments, options: Options, subject: _Subject, bench: Bench, poses: Sequence[Matrix4], stages: Stages
) -> None:
    def cut(begin_s: float, end_s: float) -> Window:
        between_s = (begin_s, end_s)
        loaded = windows.load(options.source, options.frames, WindowConfig().pairs, lambda *_: None, between_s)
        # With the rig of the whole: it may have another camera model.
        return replace(loaded.window, rig=subject.window.rig)

    if options.against_frames:
        done.frames = experiments.against_frames(bench, poses, stages)
    if options.against_slice:
        done.slices = experiments.against_slice(bench, subject.model, cut, poses, stages)
    radii = (radians(options.rotation_deg), options.translation_m)
    splits = options.halves or options.nees
    halved = experiments.in_halves(bench, splits, *radii, stages) if splits else []
    if options.halves:
        done.halves = split_halves.compare(halved, len(bench.window.pairs) // 2, bench.configuration.search.dof)
    if options.nees:
        against, true_pose = _truth(options.source, bench)
        starts = experiments.poses_of(bench, options.nees, options.rotation_deg, options.translation_m)
        apart = experiments.in_windows(bench, subject.model, cut, starts, true_pose, stages)
        done.normalised[against] = normalised_errors.normalise(normalised_errors.of_outcomes(apart), len(apart))
        # Every split sees the same frames: they count as one.
        done.normalised[OTHER_HALF] = normalised_errors.normalise(
            normalised_errors.of_differences(halved), independent=1
        )
    if options.detection:
        tried = experiments.detected(bench, options.detection, experiments.CHECKS, stages)
        done.detection = detection_of(tried, options.detection, len(bench.window.pairs))
    if options.steps:
        done.steps = steps_of(experiments.knocked(bench, options.steps, stages))


def _truth(source: str, bench: Bench) -> tuple[str, Callable[[int], Matrix4]]:
    """What the errors of windows are counted from, and its name: the truth where the source knows it, else its own
    calibration."""
    recording = open_source(source)
    if isinstance(recording, KnowsTruth):
        return SIMULATED_TRUTH, recording.truth
    return OWN_CALIBRATION, lambda _: bench.reference


def _report(
    options: Options, bench: Bench, vehicle: str, done: _Experiments, elapsed_s: dict[str, float]
) -> EvaluationReport:
    summary = statistics.summarise(done.outcomes)
    search = bench.configuration.search
    solved = done.from_reference.trial.estimate
    if solved is None:
        raise CalibrationError("there is no estimate from the source's calibration itself")
    return EvaluationReport(
        source=options.source,
        vehicle=vehicle,
        pair=bench.window.rig.pair,
        window_id=bench.window.window_id,
        pairs=len(bench.window.pairs),
        camera_model=name_of(bench.window.rig.camera),
        objective=bench.configuration.objective.kind,
        dof=search.dof,
        start_rotation_deg=options.rotation_deg,
        start_translation_m=options.translation_m,
        search_rotation_deg=search.rotation_deg,
        search_translation_m=search.translation_m if search.dof == 6 else 0.0,
        hit_rotation_deg=degrees(statistics.HIT_RAD),
        hit_translation_m=statistics.HIT_M if search.dof == 6 else None,
        interrupted=done.interrupted,
        starts=summary.starts,
        hits=summary.hits,
        hit_rate=summary.hit_rate,
        rotation_deg=angle_spread_of(summary.rotation_rad),
        translation_m=spread_of(summary.translation_m),
        median=cast("Vector6", in_degrees(summary.median)),
        bias=in_degrees(summary.bias),
        std=in_degrees(summary.std),
        rms=in_degrees(summary.rms),
        sigma=in_degrees(summary.sigma),
        from_reference=cast("Vector6", in_degrees(done.from_reference.error)),
        solve_s=spread_of(summary.solve_s),
        evaluations=spread_of(summary.evaluations),
        classified_correctly=summary.classified_correctly,
        verdicts=verdicts_of(summary.verdicts),
        stop_reasons=summary.stop_reasons,
        worst_start=statistics.worst(done.outcomes),
        frames=tuple(frames_point_of(point) for point in done.frames),
        slices=tuple(slice_point_of(point) for point in done.slices),
        halves=None if done.halves is None else halves_of(done.halves),
        detection=done.detection,
        steps=done.steps,
        normalised=tuple(normalised_of(against, found) for against, found in done.normalised.items()),
        depth_identity=solved.depth_identity,
        config_hash=solved.config_hash,
        elapsed_s=elapsed_s,
    )
