"""The page of `coec evaluate`: solves from starts all around a known pose, how many found it, and how far off they
ended."""

from collections.abc import Sequence

from coec.reports.charts import Chart, Limit, Series
from coec.reports.console import AXIS_NAMES, UNITS
from coec.reports.formatting import count, number, percent
from coec.reports.page import Block, Cell, Charts, Facts, Page, Section, Table, Text, Tone, VerdictBanner
from coec.reports.page_parts import DIGITS, SHOWN_UNITS, Provenance, depth_items
from coec_lab.experiments import evaluation_charts, evaluation_schema
from coec_lab.experiments.evaluation_tables import reference_doubt, setting

ERROR_MEANING = (
    "Bias is what the hits have in common, spread (std) what differs between them: a reference that is off shows as "
    "bias. σ claimed is what the solves say of themselves; it should not be below the rms."
)


def evaluation_page(
    report: evaluation_schema.EvaluationReport, ends: Sequence[Block], worst: Sequence[Block], made: Provenance
) -> Page:
    """The page of one method.

    Args:
        ends: pictures of where searches ended.
        worst: pictures of the start that ended farthest from the reference.
    """
    sections = [
        Section("Errors", (_spreads(report), _axes(report), Text((ERROR_MEANING,), quiet=True))),
        Section("Did it know?", (_verdicts(report),)),
        *((Section("Where the searches ended", tuple(ends)),) if ends else ()),
        *((Section(f"The worst start, number {report.worst_start}", tuple(worst)),) if worst else ()),
        *_experiments(report),
        Section("How it was evaluated", (_setting(report),)),
        made.section(_origin(report)),
    ]
    title = f"Evaluation of {report.objective} on {report.vehicle} / {report.pair}"
    return Page("coec evaluate", title, (_verdict(report),), tuple(sections))


def comparison_page(report: evaluation_schema.ComparisonReport, ends: Sequence[Block], made: Provenance) -> Page:
    """The page of several methods side by side, with pictures of where their searches ended. Each method also has a
    page of its own in the folder of its name."""
    rows: list[Sequence[str | Cell]] = [
        (
            Cell(name, href=f"{name}/report.html"),
            percent(of.hit_rate),
            number(of.rotation_deg.median),
            number(of.rotation_deg.p95),
            number(of.rotation_deg.max),
            *(number(value, DIGITS["m"]) for value in (of.translation_m.median, of.translation_m.max)),
            str(of.verdicts.accepted_misses),
            percent(of.classified_correctly),
            number(of.solve_s.median, 2),
        )
        for name, of in report.methods.items()
    ]
    errors = ("Rotation, median °", "p95 °", "Max °", "Translation, median m", "Max m")
    heads = ("Method", "Hits", *errors, "Accepted misses", "Classified correctly", "One solve, s")
    table = Table("Errors are of all starts, hits and misses", heads, rows, frozenset(range(1, len(heads))))
    best = max(report.methods.values(), key=lambda of: of.hit_rate)
    sentence = f"Of {best.starts} starts {setting(best.start_rotation_deg, best.start_translation_m)} " + ", ".join(
        f"{name} brings home {of.hits}" for name, of in report.methods.items()
    )
    missing = list(report.not_evaluated.items())
    not_allowed = Table("This source does not allow them", ("Method", "Why"), missing, prose=frozenset({1}))
    sections = (
        Section("Side by side", (table,)),
        *((Section("Where the searches ended", tuple(ends)),) if ends else ()),
        *((Section("Not evaluated", (not_allowed,)),) if missing else ()),
        made.section((("Source", report.source),)),
    )  # fmt: skip
    opening = (VerdictBanner("none", "Compared.", f"{sentence}."),)
    return Page("coec evaluate", f"Methods side by side on {best.vehicle} / {best.pair}", opening, sections)


def detection_table(detection: evaluation_schema.DetectionReport) -> Table:
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
        for row in detection.moves
    ]
    heads = ("Extrinsic", "Checks", "Flagged", "95 % interval", "Undecided", "By equation (2)")
    caption = (
        f"{count(detection.splits, 'split')} of {detection.pairs} pairs: limits learned on one half, tried on the "
        "other. What is flagged of the right extrinsic are false alarms; equation (2) is shown for comparison and "
        "decides nothing."
    )
    return Table(caption, heads, rows, frozenset(range(1, 6)))


def _verdict(report: evaluation_schema.EvaluationReport) -> VerdictBanner:
    misses = report.verdicts.accepted_misses
    limits = f"{report.hit_rotation_deg:g}°"
    if report.hit_translation_m is not None:
        limits += f" and {report.hit_translation_m:g} m"
    sentence = (
        f"{report.hits} of {report.starts} starts {setting(report.start_rotation_deg, report.start_translation_m)} end "
        f"within {limits} of the source’s calibration ({percent(report.hit_rate)}); "
        f"{percent(report.classified_correctly)} of the verdicts are right."
    )
    if misses:
        served = count(misses, "miss", "misses")
        consequence = f"{served} would have been served: look at the worst start below, and at its figures."
        doubt = reference_doubt(report)
        if doubt is not None:
            return VerdictBanner("unsure", "Beside the reference, and accepted.", sentence, (doubt, consequence))
        return VerdictBanner("bad", "Wrong and accepted.", sentence, (consequence,))
    refused = report.verdicts.failed_hits
    tone: Tone = "good" if report.hits == report.starts and not refused else "unsure"
    lost = f" {count(refused, 'right result was', 'right results were')} refused." if refused else ""
    return VerdictBanner(tone, "No miss was accepted.", f"{sentence}{lost}")


def _spreads(report: evaluation_schema.EvaluationReport) -> Table:
    def row(name: str, spread: evaluation_schema.Spread, unit: str, digits: int) -> tuple[str, ...]:
        return name, *(number(value, digits) for value in (spread.median, spread.p95, spread.max)), unit

    rows = [row("Rotation error", report.rotation_deg, "°", 3)]
    if report.dof == 6 or report.start_translation_m > 0:
        rows.append(row("Translation error", report.translation_m, "m", 4))
    rows += [row("One solve", report.solve_s, "s", 2), row("Evaluations", report.evaluations, "", 0)]
    return Table("All starts, hits and misses", ("", "Median", "95 %", "Largest", "Unit"), rows, frozenset({1, 2, 3}))


def _axes(report: evaluation_schema.EvaluationReport) -> Table:
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


def _verdicts(report: evaluation_schema.EvaluationReport) -> Table:
    counts = report.verdicts
    rows = (
        (Cell("accepted", tone="good"), str(counts.accepted_hits), str(counts.accepted_misses)),
        (Cell("refused", tone="bad"), str(counts.failed_hits), str(counts.failed_misses)),
    )
    return Table("Starts by verdict and by truth", ("Verdict", "Hits", "Misses"), rows, frozenset({1, 2}))


def _experiments(report: evaluation_schema.EvaluationReport) -> list[Section]:
    sections = []
    hit_deg = report.hit_rotation_deg
    if report.frames:
        at = [float(point.frames) for point in report.frames]
        chart = _errors_chart("Error against the number of frames", "frames in the window", at, report.frames, hit_deg)
        sections.append(Section("How many frames it takes", (Charts((chart,)), _points(report.frames, at, "Frames"))))
    if report.slices:
        at = [point.length_s for point in report.slices]
        chart = _errors_chart("Error against the length of the slice", "slice, s", at, report.slices, hit_deg)
        sections.append(
            Section("How long a slice it takes", (Charts((chart,)), _points(report.slices, at, "Slice, s")))
        )
    if report.halves is not None:
        sections.append(Section("Disjoint halves of the frames", (_halves(report.halves, report.dof),)))
    for of_claims in report.normalised:
        sections.append(Section(f"Errors against {of_claims.against}", _normalised(of_claims)))
    if report.detection is not None:
        sections.append(Section("How well a wrong extrinsic is seen", (detection_table(report.detection),)))
    if report.steps:
        sections.append(Section("Windows with a knock in them", (_steps(report.steps),)))
    return sections


def _errors_chart(
    title: str,
    x_label: str,
    at: Sequence[float],
    points: Sequence[evaluation_schema.FramesPoint | evaluation_schema.SlicePoint],
    hit_deg: float,
) -> Chart:
    def series(name: str, values: Sequence[float | None], shape: str = "line") -> Series:
        known = [(x, value) for x, value in zip(at, values, strict=True) if value is not None]
        return Series(name, known, "dotted" if shape == "dotted" else "line")

    medians = [point.rotation_deg.median for point in points]
    return Chart(
        title=title,
        x_label=x_label,
        y_label="rotation error, °",
        series=(
            series("median", medians),
            series("95th percentile", [point.rotation_deg.p95 for point in points]),
            series("σ claimed", [point.sigma_deg for point in points], "dotted"),
        ),
        description=f"the median error goes from {number(medians[0])}° to {number(medians[-1])}°",
        limits=(Limit(hit_deg, f"a hit: {hit_deg:g}°"),),
        log_y=True,
        log_x=len(at) > 1 and min(at) > 0,
        x_ticks=tuple((x, f"{x:g}") for x in at) if len(at) <= MOST_TICKS else (),
    )


MOST_TICKS = 8
"""Most points of an axis for which each gets a label; with more, labels would run into each other."""


def _points(
    points: Sequence[evaluation_schema.FramesPoint | evaluation_schema.SlicePoint], at: Sequence[float], head: str
) -> Table:
    rows = [
        (
            f"{x:g}",
            percent(point.hit_rate, 0),
            *(number(value) for value in (point.rotation_deg.median, point.rotation_deg.p95, point.rotation_deg.max)),
            number(point.sigma_deg),
        )
        for x, point in zip(at, points, strict=True)
    ]
    heads = (head, "Hits", "Median, °", "95 %, °", "Largest, °", "σ claimed, °")
    return Table("Rotation errors of all solves", heads, rows, frozenset(range(6)))


def _halves(halves: evaluation_schema.HalvesReport, dof: int) -> Table:
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
        f"{count(halves.splits, 'split')} into halves of {halves.pairs} frames: {halves.solved} solved, "
        f"{halves.accepted} accepted on both sides, {halves.hits} hit on both. No frame is in both halves."
    )
    heads = ("Difference", "Rms", "Largest", "σ claimed", "Within 3 σ", "Unit")
    return Table(caption, heads, rows, frozenset(range(1, 5)))


def _normalised(report: evaluation_schema.NormalisedErrorsReport) -> tuple[Block, ...]:
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
    table = Table(caption, heads, rows, frozenset(range(1, 8)))
    if report.nees is None:
        return (table, evaluation_charts.normalised(report))
    nees_text = (
        f"NEES per axis {number(report.nees, 2)}; of true claims {number(report.nees_low, 2)} to "
        f"{number(report.nees_high, 2)} in 95 % of evaluations with {report.independent} results that share no frame."
    )
    return table, Text((nees_text,), quiet=True), evaluation_charts.normalised(report)


def _steps(steps: Sequence[evaluation_schema.StepRow]) -> Table:
    rows = [
        (
            row.name,
            str(row.windows),
            *(percent(share, 0) for share in (row.moved, row.accepted, row.wrong, row.time_known)),
            *(f"{number(seconds, 1)}" for seconds in (row.off_s, row.told_s)),
            percent(row.holds, 0),
        )
        for row in steps
    ]
    shares = ("Refused for it", "Accepted", "Accepted and wrong", "Time known to 2 s")
    heads = ("Mount moves by", "Windows", *shares, "Off by, s", "Told within, s", "And is")
    return Table("Windows within which the mount was moved", heads, rows, frozenset(range(1, 9)))


def _setting(report: evaluation_schema.EvaluationReport) -> Facts:
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


def _origin(report: evaluation_schema.EvaluationReport) -> tuple[tuple[str, str], ...]:
    return (
        ("Source", report.source),
        ("Window", report.window_id),
        *depth_items(report.depth_identity),
        ("Configuration, hash", report.config_hash),
    )


def detection_page(detection: evaluation_schema.DetectionReport, source: str, made: Provenance) -> Page:
    """How well wrong extrinsics are detected on a recording."""
    checks = sum(row.checks for row in detection.moves)
    sentence = f"{count(checks, 'check')} at the right extrinsic and at moved ones; see which of them are flagged."
    sections = (
        Section("Checks by move", (detection_table(detection),)),
        made.section((("Source", source),)),
    )
    return Page(
        "coec diagnose", "How well a wrong extrinsic is seen", (VerdictBanner("none", "Tried.", sentence),), sections
    )
