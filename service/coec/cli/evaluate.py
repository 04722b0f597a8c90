"""`coec evaluate`: one recording, one known pose, many starts around it."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import degrees, radians
from pathlib import Path
from typing import Any, cast

from pydantic import ValidationError
from rich.progress import Progress

from coec.adapters.depth import CachedDepth, open_depth
from coec.adapters.evaluation_report import angle_spread_of, frames_point_of, in_degrees, spread_of, verdicts_of
from coec.adapters.images import CachedGreys, GreyImages
from coec.calibration import evaluation, landscape, starts
from coec.calibration.calibrator import calibrate
from coec.calibration.estimators import ESTIMATORS, look
from coec.calibration.evaluation import FramesPoint, Outcome, Statistics, Trial
from coec.calibration.objective import Objective
from coec.calibration.ports import DepthModel, ImageReader, Silence
from coec.calibration.values import Matrix4, Window
from coec.cli import calibrate as calibrate_command
from coec.cli import console, files, pictures, windows
from coec.config import CalibrationConfig, LimitsConfig, WindowConfig, describe
from coec.errors import CalibrationError, DecodeError, UsageError
from coec.geometry import se3
from coec.geometry.cameras import name_of
from coec.schemas.base import to_json
from coec.schemas.replies import EvaluationReport, Spread, Vector6

MARGIN_DEG, MARGIN_M = 5.0, 0.2
REACH_MARGIN_DEG, REACH_MARGIN_M = 3.0, 0.05
"""How far the search box reaches beyond the starts at least, so that the reference never lies on its bound and a search
may overshoot."""

SUBSETS = 20
"""Solves for every number of frames, each with frames and a start of its own."""


CSV_FIGURES = (
    *("rotation_deg", "translation_m", "hit", "verdict", "reasons", "stop_reason", "solve_s"),
    *("score_at_start", "score", "mi", "overlap", "evaluations"),
)
"""Columns of starts.csv after the two poses."""


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: str
    rotation_deg: float
    directions: int
    translation_m: float = 0.0
    depth: str | None = None
    objective: str | None = None
    dof: int | None = None
    camera_model: str | None = None
    frames: int | None = None
    no_motion_compensation: bool = False
    against_frames: bool = False
    output: Path | None = None
    as_json: bool = False


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

    def solve(self, start: Matrix4, frames: Sequence[int] | None = None) -> Outcome:
        """From one start, on all frames or on those with the given indices."""
        pairs = self.window.pairs if frames is None else tuple(self.window.pairs[index] for index in frames)
        window = replace(self.window, T_camera_lidar_start=start, pairs=pairs)
        began_s = time.perf_counter()
        try:
            estimate = calibrate(window, self.depth, self.images, self.configuration, Silence())
        except CalibrationError:
            estimate = None
        trial = Trial(start, estimate, time.perf_counter() - began_s)
        return evaluation.judge(trial, self.reference, self.configuration.search.dof)


@dataclass(frozen=True, slots=True, eq=False)
class _Score:
    """The objective of a window as a `Landscape`."""

    objective: Objective

    def score(self, T_camera_lidar: Matrix4) -> float:
        return self.objective.evaluate(T_camera_lidar).score


class _Stages:
    """A progress bar per stage, and the seconds that each took."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._began_s = self._mark_s = time.perf_counter()
        self._elapsed_s: dict[str, float] = {}

    def begin(self, stage: str, total: int | None) -> Callable[[int, str], None]:
        """What is to be called with the number of parts done and a note."""
        task = self._bars.add_task(stage, total=total, note="")

        def heard(done: int, note: str = "") -> None:
            now_s = time.perf_counter()
            self._elapsed_s[stage] = self._elapsed_s.get(stage, 0.0) + now_s - self._mark_s
            self._mark_s = now_s
            self._bars.update(task, completed=done, note=note)

        return heard

    def elapsed_s(self) -> dict[str, float]:
        """By stage, and `total`."""
        return {**self._elapsed_s, "total": time.perf_counter() - self._began_s}


def run(options: Options) -> int:
    """Prints the report; how good the figures are is for the reader to judge.

    Raises:
        CoecError: there is nothing to evaluate.
    """
    with console.progress() as bars:
        stages = _Stages(bars)
        load = stages.begin("load", None)
        loaded = windows.load(options.source, options.frames, WindowConfig().pairs, lambda done, _: load(done, ""))
        configuration = configuration_of(options, loaded.configuration)
        window = loaded.window
        if options.camera_model is not None:
            window, _ = calibrate_command.refitted(window, options.camera_model)
        images = CachedGreys(GreyImages(LimitsConfig()), len(window.pairs))
        bench = Bench(window, _inferred(window, configuration, stages), images, configuration)
        from_reference = _from_reference(bench, stages)
        poses = starts.starts(bench.reference, options.directions, radians(options.rotation_deg), options.translation_m)
        outcomes = _solve_all(bench, poses, stages)
        points = _against_frames(bench, poses, stages) if options.against_frames else ()
        if options.output is not None:
            draw = stages.begin("draw", None)
            _write_pictures(options.output, options, bench, outcomes, points)
            draw(1, "")
        elapsed_s = stages.elapsed_s()
    statistics = evaluation.summarise(outcomes)
    report = _report(options, bench, loaded.vehicle, statistics, outcomes, from_reference, points, elapsed_s)
    if options.output is not None:
        files.write(options.output / "starts.csv", _csv(bench, outcomes).encode())
        files.write(options.output / "report.json", to_json(report))
    if options.as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        _show(report)
    return 0


def configuration_of(options: Options, recorded: CalibrationConfig | None) -> CalibrationConfig:
    """As for `coec calibrate`, with a search box that holds the starts; a translated start is searched in six degrees
    of freedom unless told otherwise.

    Raises:
        UsageError: a value that does not exist, no depth, or starts too far for any search box.
    """
    configuration = calibrate_command.configuration_of(
        calibrate_command.Options(
            source=options.source,
            depth=options.depth,
            objective=options.objective,
            dof=6 if options.dof is None and options.translation_m > 0 else options.dof,
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


def _inferred(window: Window, configuration: CalibrationConfig, stages: _Stages) -> DepthModel:
    """Depth of every frame, once for all solves.

    Raises:
        CalibrationError: a frame has no depth.
    """
    depth = CachedDepth(open_depth(configuration.depth, LimitsConfig()), len(window.pairs))
    heard = stages.begin("depth", len(window.pairs))
    for done, pair in enumerate(window.pairs, start=1):
        try:
            depth.infer(pair.camera)
        except DecodeError as error:
            raise CalibrationError(f"no depth for the camera frame at {pair.stamp_ns} ns: {error}") from error
        heard(done, "")
    return depth


def _from_reference(bench: Bench, stages: _Stages) -> Outcome:
    """The solve that starts at the reference: what no start can do better than. It also compiles the kernels, so that
    the times of the others are those of solving.

    Raises:
        CalibrationError: from no start there would be an estimate.
    """
    heard = stages.begin("reference", 1)
    window = replace(bench.window, T_camera_lidar_start=bench.reference)
    calibrate(window, bench.depth, bench.images, bench.configuration, Silence())
    outcome = bench.solve(bench.reference)
    heard(1, "")
    return outcome


def _solve_all(bench: Bench, poses: Sequence[Matrix4], stages: _Stages) -> list[Outcome]:
    heard = stages.begin("starts", len(poses))
    outcomes: list[Outcome] = []
    for pose in poses:
        outcomes.append(bench.solve(pose))
        hits = sum(outcome.hit for outcome in outcomes)
        heard(len(outcomes), f"{hits} hits, {100 * hits / len(outcomes):.1f} %")
    return outcomes


def _against_frames(bench: Bench, poses: Sequence[Matrix4], stages: _Stages) -> tuple[FramesPoint, ...]:
    """The same starts for every number of frames, spread over all of them, so that numbers of frames are compared and
    nothing else."""
    available = len(bench.window.pairs)
    counts = starts.frame_counts(available)
    heard = stages.begin("frames", len(counts) * SUBSETS)
    points = []
    for row, frames in enumerate(counts):
        outcomes = []
        for trial in range(SUBSETS):
            start = poses[trial * len(poses) // SUBSETS]
            outcomes.append(bench.solve(start, starts.subset(available, frames, trial)))
            heard(row * SUBSETS + trial + 1, f"{frames} of {available}")
        points.append(evaluation.frames_point(frames, outcomes))
    return tuple(points)


def _landscape(bench: Bench) -> landscape.Landscape:
    """The objective about the reference."""
    window = replace(bench.window, T_camera_lidar_start=bench.reference)
    sight = look(window, bench.depth, bench.images, bench.configuration, Silence())
    return _Score(ESTIMATORS[bench.configuration.objective.kind](sight, bench.configuration).objective)


def _write_pictures(
    folder: Path, options: Options, bench: Bench, outcomes: Sequence[Outcome], points: Sequence[FramesPoint]
) -> None:
    # matplotlib takes a second to import.
    from coec.adapters import plots

    hits = sum(outcome.hit for outcome in outcomes)
    kind: str = bench.configuration.objective.kind
    setting = _setting(options.rotation_deg, options.translation_m)
    title = (
        f"{bench.window.window_id}: {kind}, {bench.configuration.search.dof} degrees of freedom, "
        f"{len(bench.window.pairs)} frames"
    )
    unit = starts.directions(options.directions)
    spheres = {"rotation vectors of the starts": unit}
    if options.translation_m > 0:
        spheres["translations of the starts"] = unit[starts.partners(options.directions)]
    rate = f"{hits} of {len(outcomes)} starts hit, from {setting}"
    files.write(folder / "bullseye.png", plots.bullseye(outcomes, spheres, f"{title}\n{rate}"))
    curves = {kind: landscape.scan(_landscape(bench), bench.reference, lambda *_: None)}
    files.write(folder / "landscape.png", plots.landscape(curves, f"{title}\nobjective about the source's calibration"))
    if points:
        about = f"{title} and fewer\n{SUBSETS} subsets of each size, from {setting}"
        with_translation = bench.configuration.search.dof == 6
        files.write(folder / "frames.png", plots.error_against_frames(points, with_translation, about))
    index = evaluation.worst(outcomes)
    outcome = outcomes[index]
    start_deg = windows.rotation_error_deg(outcome.trial.start, bench.reference)
    end_deg = degrees(outcome.rotation_rad)
    where = f"{bench.window.rig.pair}  worst start {index}"
    poses = {
        "overlay_before": (outcome.trial.start, f"{where}  {start_deg:.2f} deg off"),
        "overlay_after": (outcome.T_camera_lidar, f"{where}  {_verdict(outcome)}, {end_deg:.2f} deg off"),
    }
    pictures.write_overlays(folder, bench.window, poses, bench.configuration.motion_compensation)


def _report(
    options: Options,
    bench: Bench,
    vehicle: str,
    statistics: Statistics,
    outcomes: Sequence[Outcome],
    from_reference: Outcome,
    points: Sequence[FramesPoint],
    elapsed_s: dict[str, float],
) -> EvaluationReport:
    search = bench.configuration.search
    solved = from_reference.trial.estimate
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
        hit_rotation_deg=degrees(evaluation.HIT_RAD),
        hit_translation_m=evaluation.HIT_M if search.dof == 6 else None,
        starts=statistics.starts,
        hits=statistics.hits,
        hit_rate=statistics.hit_rate,
        rotation_deg=angle_spread_of(statistics.rotation_rad),
        translation_m=spread_of(statistics.translation_m),
        median=cast("Vector6", in_degrees(statistics.median)),
        bias=in_degrees(statistics.bias),
        std=in_degrees(statistics.std),
        rms=in_degrees(statistics.rms),
        sigma=in_degrees(statistics.sigma),
        from_reference=cast("Vector6", in_degrees(from_reference.error)),
        solve_s=spread_of(statistics.solve_s),
        evaluations=spread_of(statistics.evaluations),
        classified_correctly=statistics.classified_correctly,
        verdicts=verdicts_of(statistics.verdicts),
        stop_reasons=statistics.stop_reasons,
        worst_start=evaluation.worst(outcomes),
        frames=tuple(frames_point_of(point) for point in points),
        depth_identity=solved.depth_identity,
        config_hash=solved.config_hash,
        elapsed_s=elapsed_s,
    )


def _csv(bench: Bench, outcomes: Sequence[Outcome]) -> str:
    """A line per start: where it began and ended, degrees and metres from the reference about the camera axes."""
    axes = [f"{axis}_{unit}" for axis, unit in zip(console.AXES, console.UNITS, strict=True)]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["start", *(f"start_{axis}" for axis in axes), *(f"end_{axis}" for axis in axes), *CSV_FIGURES])
    for index, outcome in enumerate(outcomes):
        start = in_degrees(se3.difference(outcome.trial.start, bench.reference))
        estimate = outcome.trial.estimate
        found: list[object] = [""] * 5
        reasons = evaluation.NOT_SOLVED
        if estimate is not None:
            optimum = estimate.optimum
            found = [optimum.score_at_start, optimum.score, optimum.mi, optimum.overlap, optimum.evaluations]
            reasons = " ".join(reason.code for reason in estimate.verdict.reasons)
        judged = [
            degrees(outcome.rotation_rad),
            outcome.translation_m,
            int(outcome.hit),
            _verdict(outcome),
            reasons,
            evaluation.stop_reason(outcome),
        ]
        table.writerow([index, *start, *in_degrees(outcome.error), *judged, outcome.trial.solve_s, *found])
    return text.getvalue()


def _show(report: EvaluationReport) -> None:
    console.show(
        f"{report.window_id}: {report.pairs} pairs, {report.camera_model} camera, objective {report.objective}, "
        f"{report.dof} degrees of freedom"
    )
    limits = f"{report.hit_rotation_deg:g} deg"
    if report.hit_translation_m is not None:
        limits += f" and {report.hit_translation_m:g} m"
    box = f"±{report.search_rotation_deg:g} deg"
    if report.search_translation_m > 0:
        box += f", ±{report.search_translation_m:g} m"
    console.show(
        f"{report.starts} starts {_setting(report.start_rotation_deg, report.start_translation_m)}, search {box}"
    )
    console.show(f"{report.hits} hits within {limits}: {100 * report.hit_rate:.1f} %", "bold")
    spreads = console.table("all starts", "median", "p95", "max", "unit", right=(1, 2, 3))
    _add(spreads, "rotation error", report.rotation_deg, "deg", 3)
    if report.dof == 6 or report.start_translation_m > 0:
        _add(spreads, "translation error", report.translation_m, "m", 3)
    _add(spreads, "one solve", report.solve_s, "s", 2)
    _add(spreads, "evaluations", report.evaluations, "", 0)
    console.out.print(spreads)
    axes = console.table(
        *(
            "error",
            "bias of hits",
            "std of hits",
            "rms of hits",
            "σ claimed",
            "median of all",
            "from reference",
            "unit",
        ),
        right=range(1, 7),
    )
    for axis in range(report.dof):
        axes.add_row(
            console.AXIS_NAMES[axis],
            console.figure(report.bias[axis], sign=True),
            console.figure(report.std[axis]),
            console.figure(report.rms[axis]),
            console.figure(report.sigma[axis]),
            console.figure(report.median[axis], sign=True),
            console.figure(report.from_reference[axis], sign=True),
            console.UNITS[axis],
        )
    console.out.print(axes)
    verdicts = console.table("verdict", "hits", "misses", right=(1, 2))
    counts = report.verdicts
    verdicts.add_row(console.styled("accepted"), str(counts.accepted_hits), str(counts.accepted_misses))
    verdicts.add_row(console.styled("failed"), str(counts.failed_hits), str(counts.failed_misses))
    console.out.print(verdicts)
    ended = ", ".join(f"{count} {reason}" for reason, count in report.stop_reasons.items())
    console.show(f"classified correctly: {100 * report.classified_correctly:.1f} %; searches ended: {ended}")
    if report.frames:
        _show_frames(report)
    console.show("  ".join(f"{stage} {seconds:.1f} s" for stage, seconds in report.elapsed_s.items()))


def _show_frames(report: EvaluationReport) -> None:
    table = console.table("frames", "subsets", "hits", "median", "p95", "max", "unit", right=range(6))
    for point in report.frames:
        errors = point.rotation_deg
        figures = [console.figure(value) for value in (errors.median, errors.p95, errors.max)]
        table.add_row(str(point.frames), str(point.subsets), f"{100 * point.hit_rate:.0f} %", *figures, "deg")
    console.out.print(table)


def _add(table: Any, name: str, spread: Spread, unit: str, digits: int) -> None:
    figures = [console.figure(value, digits) for value in (spread.median, spread.p95, spread.max)]
    table.add_row(name, *figures, unit)


def _setting(rotation_deg: float, translation_m: float) -> str:
    return f"{rotation_deg:g} deg" + (f" and {translation_m:g} m away" if translation_m > 0 else " away")


def _verdict(outcome: Outcome) -> str:
    return "accepted" if outcome.accepted else "failed"
