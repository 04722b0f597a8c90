"""The page of `coec evaluate`, and what it prints: solves from starts all around a known pose, how many found it, and
how far off they ended. Page and console show the same sections; only pictures are for the page alone."""

from collections.abc import Sequence
from dataclasses import replace

from coec.reports import console
from coec.reports.charts import Chart, Limit, Series
from coec.reports.formatting import count, number, percent
from coec.reports.page import Block, Cell, Charts, Page, Section, Table, Text, Tone, VerdictBanner
from coec.reports.page_parts import Provenance, depth_items
from coec_lab.experiments import evaluation_charts, evaluation_schema
from coec_lab.experiments import evaluation_tables as tables
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
    sections = (*_sections(report, ends, worst), made.section(_origin(report)))
    title = f"Evaluation of {report.objective} on {report.vehicle} / {report.pair}"
    return Page("coec evaluate", title, (_verdict(report),), sections)


def show(report: evaluation_schema.EvaluationReport) -> None:
    """Prints the figures of one method."""
    console.show(f"{report.window_id}: {_verdict(report).sentence}", "bold")
    doubt = reference_doubt(report)
    if doubt is not None:
        console.show(doubt, "yellow")
    for section in _sections(report):
        console.show_section(section)


def _sections(
    report: evaluation_schema.EvaluationReport, ends: Sequence[Block] = (), worst: Sequence[Block] = ()
) -> list[Section]:
    errors = tables.spreads_table(report), tables.axes_table(report)
    return [
        Section("Errors", (*errors, Text((ERROR_MEANING,), quiet=True))),
        Section("Did it know?", (tables.verdicts_table(report),)),
        *((Section("Where the searches ended", tuple(ends)),) if ends else ()),
        *((Section(f"The worst start, number {report.worst_start}", tuple(worst)),) if worst else ()),
        *_experiments(report),
        Section("How it was evaluated", (tables.setting_facts(report),)),
    ]


def comparison_page(report: evaluation_schema.ComparisonReport, ends: Sequence[Block], made: Provenance) -> Page:
    """The page of several methods side by side, with pictures of where their searches ended. Each method also has a
    page of its own in the folder of its name."""
    table = tables.comparison_table(report)
    links: tuple[str | Cell, ...] = ("Page", *(Cell("open", href=f"{name}/report.html") for name in report.methods), "")
    best = max(report.methods.values(), key=lambda of: of.hit_rate)
    sentence = f"Of {best.starts} starts {setting(best.start_rotation_deg, best.start_translation_m)} " + ", ".join(
        f"{name} brings home {of.hits}" for name, of in report.methods.items()
    )
    missing = list(report.not_evaluated.items())
    not_allowed = Table("This source does not allow them", ("Method", "Why"), missing, prose=frozenset({1}))
    sections = (
        Section("Side by side", (replace(table, rows=(*table.rows, links)),)),
        *((Section("Where the searches ended", tuple(ends)),) if ends else ()),
        *((Section("Not evaluated", (not_allowed,)),) if missing else ()),
        made.section((("Source", report.source),)),
    )  # fmt: skip
    opening = (VerdictBanner("none", "Compared.", f"{sentence}."),)
    return Page("coec evaluate", f"Methods side by side on {best.vehicle} / {best.pair}", opening, sections)


def show_comparison(report: evaluation_schema.ComparisonReport) -> None:
    """Prints the methods side by side, and why some are missing."""
    first = next(iter(report.methods.values()))
    console.show(
        f"{first.window_id}: {count(first.pairs, 'pair')}, {first.camera_model} camera, {first.dof} degrees of freedom"
    )
    console.show(f"{first.starts} starts {setting(first.start_rotation_deg, first.start_translation_m)}")
    console.show_block(tables.comparison_table(report))
    for name, reason in report.not_evaluated.items():
        console.show(f"{name} was not evaluated: {reason}", "yellow")
    for name, method in report.methods.items():
        for section in _experiments(method):
            console.show_section(replace(section, title=f"{name}: {section.title}"))
    console.show(_seconds(report.elapsed_s))


def show_closure(report: evaluation_schema.ClosureReport) -> None:
    """Prints how two calibrations close."""
    console.show(f"A {report.source_a}")
    console.show(f"B {report.source_b}")
    known = ", ".join(f"{number(value)} {unit}" for value, unit in zip(report.known, console.UNITS, strict=True))
    origin = "as the recordings tell" if report.from_recordings else "as given"
    console.show(f"{report.relation}; A in the frame of B, {origin}: {known}")
    console.show(
        f"{report.trials} starts {setting(report.start_rotation_deg, report.start_translation_m)}, objective "
        f"{report.objective}, {report.dof} degrees of freedom"
    )
    for group in report.groups:
        pairs = f"{group.pairs_a}" if group.pairs_a == group.pairs_b else f"{group.pairs_a} and {group.pairs_b}"
        spreads = [("Rotation", group.rotation_deg, "°", 3)]
        if report.dof == 6:
            spreads.append(("Translation", group.translation_m, "m", 4))
        errors = tables.spread_table("Closure error", spreads)
        console.show_section(Section(f"{group.frames}: {pairs} pairs", (errors,)))
        console.show_section(_normalised(group.errors))
    console.show(_seconds(report.elapsed_s))


def _seconds(elapsed_s: dict[str, float]) -> str:
    return "  ".join(f"{stage} {seconds:.1f} s" for stage, seconds in elapsed_s.items())


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


def _experiments(report: evaluation_schema.EvaluationReport) -> list[Section]:
    sections = []
    hit_deg = report.hit_rotation_deg
    if report.frames:
        at = [float(point.frames) for point in report.frames]
        chart = _errors_chart("Error against the number of frames", "frames in the window", at, report.frames, hit_deg)
        sections.append(Section("How many frames it takes", (Charts((chart,)), tables.frames_table(report.frames))))
    if report.slices:
        at = [point.length_s for point in report.slices]
        chart = _errors_chart("Error against the length of the slice", "slice, s", at, report.slices, hit_deg)
        sections.append(Section("How long a slice it takes", (Charts((chart,)), tables.slices_table(report.slices))))
    if report.halves is not None:
        sections.append(Section("Disjoint halves of the frames", (tables.halves_table(report.halves, report.dof),)))
    sections += [_normalised(of_claims) for of_claims in report.normalised]
    if report.detection is not None:
        sections.append(Section("How well a wrong extrinsic is seen", (tables.detection_table(report.detection),)))
    if report.steps:
        sections.append(Section("Windows with a knock in them", (tables.steps_table(report.steps),)))
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


def _normalised(report: evaluation_schema.NormalisedErrorsReport) -> Section:
    blocks: tuple[Block, ...] = (tables.normalised_table(report),)
    if report.nees is not None:
        nees = (
            f"NEES per axis {number(report.nees, 2)}; of true claims {number(report.nees_low, 2)} to "
            f"{number(report.nees_high, 2)} in 95 % of evaluations with {report.independent} results that share no "
            "frame."
        )
        blocks = (*blocks, Text((nees,), quiet=True))
    return Section(f"Errors against {report.against}", (*blocks, evaluation_charts.normalised(report)))


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
        Section("Checks by move", (tables.detection_table(detection),)),
        made.section((("Source", source),)),
    )
    return Page(
        "coec diagnose", "How well a wrong extrinsic is seen", (VerdictBanner("none", "Tried.", sentence),), sections
    )
