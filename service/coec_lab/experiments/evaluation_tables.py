"""The tables of `coec evaluate`, which its pages and the console both show, and starts.csv."""

import csv
import io
from collections.abc import Sequence
from math import degrees, hypot, inf

from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.reports.console import AXES, AXIS_NAMES, UNITS
from coec.reports.formatting import count, number, percent
from coec.reports.page import Cell, Facts, Table
from coec.reports.page_parts import DIGITS, SHOWN_UNITS, finite_degrees
from coec_lab.experiments import evaluation_schema, solve_statistics

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


def verdict(outcome: solve_statistics.SolveOutcome) -> str:
    """The decision in one word."""
    return "accepted" if outcome.accepted else "failed"


def csv_of(reference: Matrix4, outcomes: Sequence[solve_statistics.SolveOutcome]) -> str:
    """A line per start: its begin and its end relative to the reference (4, 4), degrees and metres, camera axes."""
    axes = [f"{axis}_{unit}" for axis, unit in zip(AXES, UNITS, strict=True)]
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


def comparison_table(report: evaluation_schema.ComparisonReport) -> Table:
    """The methods side by side: a row per figure, with its unit last."""
    methods = list(report.methods.values())

    def row(name: str, unit: str, values: Sequence[float | None], digits: int, sign: bool = False) -> list[str]:
        return [name, *(number(value, digits, sign) for value in values), unit]

    def errors(name: str, of_unit: str, spreads: Sequence[evaluation_schema.Spread]) -> list[list[str]]:
        unit, digits = SHOWN_UNITS[of_unit], DIGITS[of_unit]
        return [
            row(f"{name}, median", unit, [spread.median for spread in spreads], digits),
            row(f"{name}, 95 %", unit, [spread.p95 for spread in spreads], digits),
            row(f"{name}, largest", unit, [spread.max for spread in spreads], digits),
        ]

    dof = methods[0].dof
    rows = [row("Hits", "%", [100 * method.hit_rate for method in methods], 1)]
    rows += errors("Rotation error", "deg", [method.rotation_deg for method in methods])
    if dof == 6 or methods[0].start_translation_m > 0:
        rows += errors("Translation error", "m", [method.translation_m for method in methods])
    for axis in range(dof):
        name, unit, digits = AXIS_NAMES[axis], SHOWN_UNITS[UNITS[axis]], DIGITS[UNITS[axis]]
        rows.append(row(f"Bias of hits, {name}", unit, [method.bias[axis] for method in methods], digits, sign=True))
        rows.append(row(f"Std of hits, {name}", unit, [method.std[axis] for method in methods], digits))
    rows.append(row("Accepted misses", "", [method.verdicts.accepted_misses for method in methods], 0))
    rows.append(row("Classified correctly", "%", [100 * method.classified_correctly for method in methods], 1))
    rows.append(row("One solve, median", "s", [method.solve_s.median for method in methods], 2))
    heads = ("", *report.methods, "Unit")
    return Table("Errors are of all starts, hits and misses", heads, rows, frozenset(range(1, 1 + len(methods))))


def spread_table(caption: str, rows: Sequence[tuple[str, evaluation_schema.Spread, str, int]]) -> Table:
    """Spreads of figures, each with its name, unit and number of digits."""
    shown = [
        (name, *(number(value, digits) for value in (spread.median, spread.p95, spread.max)), unit)
        for name, spread, unit, digits in rows
    ]
    return Table(caption, ("", "Median", "95 %", "Largest", "Unit"), shown, frozenset({1, 2, 3}))


def spreads_table(report: evaluation_schema.EvaluationReport) -> Table:
    """Errors, time and effort of all searches."""
    rows = [("Rotation error", report.rotation_deg, "°", 3)]
    if report.dof == 6 or report.start_translation_m > 0:
        rows.append(("Translation error", report.translation_m, "m", 4))
    rows += [("One solve", report.solve_s, "s", 2), ("Evaluations", report.evaluations, "", 0)]
    return spread_table("All starts, hits and misses", rows)


def axes_table(report: evaluation_schema.EvaluationReport) -> Table:
    """Errors along each axis of the camera."""
    columns = (report.bias, report.std, report.rms, report.sigma, report.median, report.from_reference)
    rows = [
        (
            AXIS_NAMES[axis],
            *(number(of[axis], DIGITS[UNITS[axis]], sign=at in (0, 4, 5)) for at, of in enumerate(columns)),
            SHOWN_UNITS[UNITS[axis]],
        )
        for axis in range(report.dof)
    ]
    named = ("Bias of hits", "Std of hits", "Rms of hits", "σ claimed", "Median of all", "From the reference")
    return Table("Error per axis of the camera", ("Axis", *named, "Unit"), rows, frozenset(range(1, 7)))


def verdicts_table(report: evaluation_schema.EvaluationReport) -> Table:
    """Starts by verdict and by truth."""
    counts = report.verdicts
    rows = (
        (Cell("accepted", tone="good"), str(counts.accepted_hits), str(counts.accepted_misses)),
        (Cell("refused", tone="bad"), str(counts.failed_hits), str(counts.failed_misses)),
    )
    return Table("Starts by verdict and by truth", ("Verdict", "Hits", "Misses"), rows, frozenset({1, 2}))


def frames_table(points: Sequence[evaluation_schema.FramesPoint]) -> Table:
    """Rotation errors by the number of frames."""
    rows = [(f"{point.frames}", f"{point.subsets}", *_errors(point)) for point in points]
    return Table("Rotation errors of all solves", ("Frames", "Subsets", *ERRORS), rows, frozenset(range(7)))


def slices_table(points: Sequence[evaluation_schema.SlicePoint]) -> Table:
    """Rotation errors by the length of the slice."""
    rows = [
        (f"{point.length_s:g}", f"{point.slices}", f"{point.pairs:g}", f"{point.solves}", *_errors(point))
        for point in points
    ]
    heads = ("Slice, s", "Slices", "Frames", "Solves", *ERRORS)
    return Table("Rotation errors of all solves", heads, rows, frozenset(range(9)))


ERRORS = ("Hits", "Median, °", "95 %, °", "Largest, °", "σ claimed, °")
"""Heads of the columns of `_errors`."""


def _errors(point: evaluation_schema.FramesPoint | evaluation_schema.SlicePoint) -> list[str]:
    errors = point.rotation_deg
    figures = [number(value) for value in (errors.median, errors.p95, errors.max, point.sigma_deg)]
    return [percent(point.hit_rate, 0), *figures]


def halves_table(halves: evaluation_schema.HalvesReport, dof: int) -> Table:
    """Differences between results of disjoint halves."""
    rows = [
        (
            AXIS_NAMES[axis],
            *(number(of[axis], DIGITS[UNITS[axis]]) for of in (halves.rms, halves.largest, halves.sigma)),
            percent(halves.covered[axis]),
            SHOWN_UNITS[UNITS[axis]],
        )
        for axis in range(dof)
    ]
    caption = (
        f"{count(halves.splits, 'split')} into halves of {count(halves.pairs, 'frame')}: {halves.solved} solved, "
        f"{halves.accepted} accepted on both sides, {halves.hits} hit on both. No frame is in both halves."
    )
    heads = ("Difference", "Rms", "Largest", "σ claimed", "Within 3 σ", "Unit")
    return Table(caption, heads, rows, frozenset(range(1, 5)))


def normalised_table(report: evaluation_schema.NormalisedErrorsReport) -> Table:
    """Errors beside what was claimed for them."""
    rows = [
        (
            name,
            *(number(of[axis], 4) for of in (report.rms, report.largest, report.sigma)),
            number(report.sigma_over_rms[axis], 2),
            *(percent(of[axis]) for of in (report.within_1_sigma, report.within_2_sigma, report.within_3_sigma)),
            SHOWN_UNITS[UNITS[axis]],
        )
        for axis, name in enumerate(AXIS_NAMES)
        if report.sigma[axis] is not None
    ]
    heads = ("Error", "Rms", "Largest", "σ claimed", "σ / rms", "Within 1 σ", "2 σ", "3 σ", "Unit")
    caption = f"{report.judged} accepted, {report.refused} refused. True claims hold 68.3, 95.4 and 99.7 %."
    return Table(caption, heads, rows, frozenset(range(1, 8)))


def detection_table(report: evaluation_schema.DetectionReport) -> Table:
    """Checks after moves of the extrinsic, and how many of them each classifier flags."""
    rows = [
        (
            row.name,
            str(row.checks),
            percent(row.flagged),
            f"{percent(row.flagged_low)} to {percent(row.flagged_high)}",
            percent(row.undecided),
            percent(row.flagged_by_paper),
        )
        for row in report.moves
    ]
    heads = ("Extrinsic", "Checks", "Flagged", "95 % interval", "Undecided", "By equation (2)")
    caption = (
        f"{count(report.splits, 'split')} of {count(report.pairs, 'pair')}: limits learned on one half, tried on the "
        "other; no pair is in both. What is flagged of the right extrinsic are false alarms; equation (2) is shown for "
        "comparison and decides nothing."
    )
    return Table(caption, heads, rows, frozenset(range(1, 6)))


def steps_table(tried: Sequence[evaluation_schema.StepRow]) -> Table:
    """Simulated steps of the mount: how many were noticed, and how well their times are known."""
    rows = [
        (
            row.name,
            str(row.windows),
            *(percent(share, 0) for share in (row.moved, row.accepted, row.wrong, row.time_known)),
            *(number(seconds, 1) for seconds in (row.off_s, row.told_s)),
            percent(row.holds, 0),
        )
        for row in tried
    ]
    shares = ("Refused for it", "Accepted", "Accepted and wrong", "Time known to 2 s")
    heads = ("Mount moves by", "Windows", *shares, "Off by, s", "Told within, s", "And is")
    return Table("Windows within which the mount was moved", heads, rows, frozenset(range(1, 9)))


def setting_facts(report: evaluation_schema.EvaluationReport) -> Facts:
    """How it was evaluated."""
    box = f"±{report.search_rotation_deg:g}°"
    if report.search_translation_m > 0:
        box += f", ±{report.search_translation_m:g} m"
    stop_reasons = ", ".join(f"{reason.replace('_', ' ')} {starts}" for reason, starts in report.stop_reasons.items())
    return Facts(
        (
            ("Objective", report.objective),
            ("Degrees of freedom", str(report.dof)),
            ("Camera model", report.camera_model),
            ("Pairs of image and sweep", str(report.pairs)),
            ("Starts", f"{report.starts}, {setting(report.start_rotation_deg, report.start_translation_m)}"),
            ("Search box", box),
            ("Searches ended as", stop_reasons),
            *((f"Time, {stage}", f"{number(seconds, 1)} s") for stage, seconds in report.elapsed_s.items()),
        )
    )
