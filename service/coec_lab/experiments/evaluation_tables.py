"""The tables of `coec evaluate`: for people, and starts.csv."""

import csv
import io
from collections.abc import Sequence
from math import degrees, hypot, inf
from typing import Any

from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.reports import console
from coec.reports.formatting import count
from coec.reports.page_parts import finite_degrees
from coec_lab.experiments import evaluation_schema, solve_statistics
from coec_lab.experiments.detection import RIGHT
from coec_lab.experiments.solve_statistics import SolveOutcome

CSV_FIGURES = (
    *("rotation_deg", "translation_m", "hit", "verdict", "reasons", "stop_reason", "solve_s"),
    *("score_at_start", "score", "mi", "overlap", "evaluations"),
)
"""Columns of starts.csv after the two poses."""


def setting(rotation_deg: float, translation_m: float) -> str:
    """How far away the starts are, in words."""
    return f"{rotation_deg:g}°" + (f" and {translation_m:g} m away" if translation_m > 0 else " away")


def reference_doubt(report: evaluation_schema.EvaluationReport) -> str | None:
    """Where searches from all around meet beside the source's calibration, and one that began at it ends there, too: a
    sentence that says so, as the misses may be the reference's. None where they do not."""
    difference = [middle - end for middle, end in zip(report.median, report.from_reference, strict=True)]
    if not _is_hit(report, difference) or _is_hit(report, report.from_reference):
        return None
    where = f"{hypot(*report.from_reference[:3]):.2f}°"
    if report.hit_translation_m is not None:
        where += f" and {hypot(*report.from_reference[3:]):.2f} m"
    return (
        f"Searches from all around meet {where} beside the source's calibration, and one that began at it ended there, "
        "too: either that calibration is off, or this objective is on this recording. The close-ups show which."
    )


def _is_hit(report: evaluation_schema.EvaluationReport, error: Sequence[float]) -> bool:
    """Whether a vector of six, deg and m, is within what counts as a hit."""
    limit_m = inf if report.hit_translation_m is None else report.hit_translation_m
    return hypot(*error[:3]) < report.hit_rotation_deg and hypot(*error[3:]) < limit_m


def verdict(outcome: SolveOutcome) -> str:
    """The decision in one word."""
    return "accepted" if outcome.accepted else "failed"


def csv_of(reference: Matrix4, outcomes: Sequence[SolveOutcome]) -> str:
    """A line per start: its begin and its end relative to the reference (4, 4), degrees and metres, camera axes."""
    axes = [f"{axis}_{unit}" for axis, unit in zip(console.AXES, console.UNITS, strict=True)]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["start", *(f"start_{axis}" for axis in axes), *(f"end_{axis}" for axis in axes), *CSV_FIGURES])
    for index, outcome in enumerate(outcomes):
        start = finite_degrees(se3.difference(outcome.trial.start, reference))
        estimate = outcome.trial.estimate
        figures: list[object] = [""] * 5
        reasons = solve_statistics.NOT_SOLVED
        if estimate is not None:
            optimum = estimate.optimum
            figures = [optimum.score_at_start, optimum.score, optimum.mi, optimum.overlap, optimum.evaluations]
            reasons = " ".join(reason.code for reason in estimate.verdict.reasons)
        judged = [
            degrees(outcome.rotation_rad),
            outcome.translation_m,
            int(outcome.hit),
            verdict(outcome),
            reasons,
            solve_statistics.stop_reason(outcome),
        ]
        table.writerow([index, *start, *finite_degrees(outcome.error), *judged, outcome.trial.solve_s, *figures])
    return text.getvalue()


def show_comparison(report: evaluation_schema.ComparisonReport) -> None:
    """Prints the methods side by side, and why some are missing."""
    first = next(iter(report.methods.values()))
    console.show(
        f"{first.window_id}: {count(first.pairs, 'pair')}, {first.camera_model} camera, {first.dof} degrees of freedom"
    )
    console.show(f"{first.starts} starts {setting(first.start_rotation_deg, first.start_translation_m)}")
    names = list(report.methods)
    table = console.table("", *names, "unit", right=range(1, 1 + len(names)))
    for row, unit, values in _comparison(report):
        table.add_row(row, *values, unit)
    console.out.print(table)
    for name, reason in report.not_evaluated.items():
        console.show(f"{name} was not evaluated: {reason}", "yellow")
    for name, method in report.methods.items():
        experiments = (method.frames, method.slices, method.halves, method.normalised, method.detection, method.steps)
        if any(experiments):
            console.show(name, "bold")
            _show_experiments(method)
    console.show(_seconds(report.elapsed_s))


def show(report: evaluation_schema.EvaluationReport) -> None:
    """Prints the figures of one method."""
    console.show(
        f"{report.window_id}: {count(report.pairs, 'pair')}, {report.camera_model} camera, objective "
        f"{report.objective}, {report.dof} degrees of freedom"
    )
    limits = f"{report.hit_rotation_deg:g} deg"
    if report.hit_translation_m is not None:
        limits += f" and {report.hit_translation_m:g} m"
    box = f"±{report.search_rotation_deg:g} deg"
    if report.search_translation_m > 0:
        box += f", ±{report.search_translation_m:g} m"
    away = setting(report.start_rotation_deg, report.start_translation_m)
    console.show(f"{count(report.starts, 'start')} {away}, search {box}")
    console.show(f"{count(report.hits, 'hit')} within {limits}: {100 * report.hit_rate:.1f} %", "bold")
    doubt = reference_doubt(report)
    if doubt is not None:
        console.show(doubt, "yellow")
    spreads = console.table("all starts", "median", "p95", "max", "unit", right=(1, 2, 3))
    _add(spreads, "rotation error", report.rotation_deg, "deg", 3)
    if report.dof == 6 or report.start_translation_m > 0:
        _add(spreads, "translation error", report.translation_m, "m", 3)
    _add(spreads, "one solve", report.solve_s, "s", 2)
    _add(spreads, "evaluations", report.evaluations, "", 0)
    console.out.print(spreads)
    _show_axes(report)
    verdicts = console.table("verdict", "hits", "misses", right=(1, 2))
    counts = report.verdicts
    verdicts.add_row(console.styled("accepted"), str(counts.accepted_hits), str(counts.accepted_misses))
    verdicts.add_row(console.styled("failed"), str(counts.failed_hits), str(counts.failed_misses))
    console.out.print(verdicts)
    stop_reasons = ", ".join(f"{starts} {reason}" for reason, starts in report.stop_reasons.items())
    console.show(f"classified correctly: {100 * report.classified_correctly:.1f} %; searches ended: {stop_reasons}")
    _show_experiments(report)
    console.show(_seconds(report.elapsed_s))


def _comparison(report: evaluation_schema.ComparisonReport) -> list[tuple[str, str, list[str]]]:
    """Rows: name, unit, and one figure per method."""
    methods = list(report.methods.values())
    dof = methods[0].dof

    def row(name: str, unit: str, values: Sequence[float | None], digits: int = 3, sign: bool = False) -> Any:
        return name, unit, [console.figure(value, digits, sign) for value in values]

    rows = [row("hits", "%", [100 * method.hit_rate for method in methods], 1)]
    for name in ("median", "p95", "max"):
        rows.append(row(f"rotation error, {name}", "deg", [getattr(method.rotation_deg, name) for method in methods]))
    if dof == 6:
        for name in ("median", "p95", "max"):
            values = [getattr(method.translation_m, name) for method in methods]
            rows.append(row(f"translation error, {name}", "m", values))
    for axis in range(dof):
        title, unit = console.AXIS_NAMES[axis], console.UNITS[axis]
        rows.append(row(f"bias of hits, {title}", unit, [method.bias[axis] for method in methods], sign=True))
        rows.append(row(f"std of hits, {title}", unit, [method.std[axis] for method in methods]))
    rows.append(row("accepted misses", "", [method.verdicts.accepted_misses for method in methods], 0))
    rows.append(row("classified correctly", "%", [100 * method.classified_correctly for method in methods], 1))
    rows.append(row("one solve, median", "s", [method.solve_s.median for method in methods], 2))
    return rows


def _show_axes(report: evaluation_schema.EvaluationReport) -> None:
    columns = ("error", "bias of hits", "std of hits", "rms of hits", "σ claimed", "median of all", "from reference")
    axes = console.table(*columns, "unit", right=range(1, 7))
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


def _show_experiments(report: evaluation_schema.EvaluationReport) -> None:
    if report.frames:
        frames = console.table("frames", "subsets", "hits", "median", "p95", "max", "σ claimed", "unit", right=range(7))
        for point in report.frames:
            frames.add_row(str(point.frames), str(point.subsets), *_errors(point), "deg")
        console.out.print(frames)
    if report.slices:
        columns = ("slice", "slices", "frames", "solves", "hits", "median", "p95", "max", "σ claimed")
        slices = console.table(*columns, "unit", right=range(9))
        for of_length in report.slices:
            counts = (f"{of_length.slices}", f"{of_length.pairs:g}", f"{of_length.solves}")
            slices.add_row(f"{of_length.length_s:.1f} s", *counts, *_errors(of_length), "deg")
        console.out.print(slices)
    if report.halves is not None:
        _show_halves(report.halves, report.dof)
    for of_claims in report.normalised:
        _show_normalised(of_claims)
    if report.detection is not None:
        show_detection(report.detection)
    if report.steps:
        _show_steps(report.steps)


def show_closure(report: evaluation_schema.ClosureReport) -> None:
    """Prints how two calibrations close."""
    console.show(f"A {report.source_a}")
    console.show(f"B {report.source_b}")
    known = ", ".join(
        f"{console.figure(value)} {unit}" for value, unit in zip(report.known, console.UNITS, strict=True)
    )
    origin = "as the recordings tell" if report.from_recordings else "as given"
    console.show(f"{report.relation}; A in the frame of B, {origin}: {known}")
    console.show(
        f"{report.trials} starts {setting(report.start_rotation_deg, report.start_translation_m)}, objective "
        f"{report.objective}, {report.dof} degrees of freedom"
    )
    for group in report.groups:
        pairs = f"{group.pairs_a}" if group.pairs_a == group.pairs_b else f"{group.pairs_a} and {group.pairs_b}"
        console.show(f"{group.frames}: {pairs} pairs", "bold")
        spreads = console.table("closure error", "median", "p95", "max", "unit", right=(1, 2, 3))
        _add(spreads, "rotation", group.rotation_deg, "deg", 3)
        if report.dof == 6:
            _add(spreads, "translation", group.translation_m, "m", 4)
        console.out.print(spreads)
        _show_normalised(group.errors)
    console.show(_seconds(report.elapsed_s))


def _show_normalised(errors: evaluation_schema.NormalisedErrorsReport) -> None:
    """Prints errors beside what was claimed for them."""
    console.show(f"errors against {errors.against}: {errors.judged} accepted, {errors.refused} refused")
    columns = ("error", "rms", "largest", "σ claimed", "σ / rms", "within 1 σ", "2 σ", "3 σ")
    table = console.table(*columns, "unit", right=range(1, len(columns)))
    for axis, name in enumerate(console.AXIS_NAMES):
        if errors.sigma[axis] is None:
            continue
        coverage = [row[axis] for row in (errors.within_1_sigma, errors.within_2_sigma, errors.within_3_sigma)]
        table.add_row(
            name,
            console.figure(errors.rms[axis], 4),
            console.figure(errors.largest[axis], 4),
            console.figure(errors.sigma[axis], 4),
            console.figure(errors.sigma_over_rms[axis], 2),
            *("-" if share is None else f"{100 * share:.1f} %" for share in coverage),
            console.UNITS[axis],
        )
    console.out.print(table)
    if errors.nees is not None:
        limits = f"{console.figure(errors.nees_low, 2)} to {console.figure(errors.nees_high, 2)}"
        console.show(
            f"NEES per axis {errors.nees:.2f}; of true claims {limits} in 95 % of evaluations with "
            f"{errors.independent} results that share no frame"
        )


def show_detection(detection: evaluation_schema.DetectionReport) -> None:
    """Prints checks of moved extrinsics, and how many of them each classifier flags."""
    table = console.table("extrinsic", "checks", "flagged", "95 %", "undecided", "by equation (2)", right=range(1, 6))
    for row in detection.moves:
        between = f"{100 * row.flagged_low:.1f} to {100 * row.flagged_high:.1f} %"
        undecided, by_paper = f"{100 * row.undecided:.1f} %", f"{100 * row.flagged_by_paper:.1f} %"
        table.add_row(row.name, str(row.checks), f"{100 * row.flagged:.1f} %", between, undecided, by_paper)
    console.out.print(table)
    console.show(
        f"{count(detection.splits, 'split')} of {count(detection.pairs, 'pair')}: limits learned on one half, tried on "
        "the other; no pair is in both"
    )
    right = next((row for row in detection.moves if row.name == RIGHT), None)
    if right is not None:
        console.show(
            "equation (2) is shown for comparison and decides nothing: it flags "
            f"{100 * right.flagged_by_paper:.1f} % of right extrinsics"
        )


def _show_steps(steps: Sequence[evaluation_schema.StepRow]) -> None:
    shares = ("refused for it", "accepted", "accepted and wrong", "time known to 2 s")
    times = ("off by", "told to be within", "and is")
    table = console.table("mount moves by", "windows", *shares, *times, right=range(1, 9))
    for row in steps:
        moved, accepted, wrong, known, holds = (
            "-" if share is None else f"{100 * share:.0f} %"
            for share in (row.moved, row.accepted, row.wrong, row.time_known, row.holds)
        )
        off, interval = ("-" if seconds is None else f"{seconds:.1f} s" for seconds in (row.off_s, row.told_s))
        table.add_row(row.name, str(row.windows), moved, accepted, wrong, known, off, interval, holds)
    console.out.print(table)


def _show_halves(halves: evaluation_schema.HalvesReport, dof: int) -> None:
    console.show(
        f"{count(halves.splits, 'split')} into halves of {count(halves.pairs, 'frame')}: {halves.solved} solved, "
        f"{halves.accepted} accepted on both sides, {halves.hits} hit on both"
    )
    table = console.table("difference", "rms", "largest", "σ claimed", "within 3 σ", "unit", right=range(1, 5))
    for axis in range(dof):
        covered = halves.covered[axis]
        table.add_row(
            console.AXIS_NAMES[axis],
            console.figure(halves.rms[axis]),
            console.figure(halves.largest[axis]),
            console.figure(halves.sigma[axis]),
            "-" if covered is None else f"{100 * covered:.1f} %",
            console.UNITS[axis],
        )
    console.out.print(table)


def _errors(point: evaluation_schema.FramesPoint | evaluation_schema.SlicePoint) -> list[str]:
    """Hits, median, 95th percentile, largest and claimed rotation error."""
    errors = point.rotation_deg
    figures = [console.figure(value) for value in (errors.median, errors.p95, errors.max, point.sigma_deg)]
    return [f"{100 * point.hit_rate:.0f} %", *figures]


def _add(table: Any, name: str, spread: evaluation_schema.Spread, unit: str, digits: int) -> None:
    figures = [console.figure(value, digits) for value in (spread.median, spread.p95, spread.max)]
    table.add_row(name, *figures, unit)


def _seconds(elapsed_s: dict[str, float]) -> str:
    return "  ".join(f"{stage} {seconds:.1f} s" for stage, seconds in elapsed_s.items())
