"""The page of a fleet: one HTML file with everything in it."""

from collections.abc import Sequence
from datetime import datetime
from math import inf

from coec.reports.console import figure
from coec.reports.formatting import NONE, count, day, percent
from coec.reports.page import Block, Cell, Page, Section, Table, Text, Trend, VerdictBanner
from coec.reports.page_parts import Provenance
from coec.schemas.documents import AXES, FalseAlarms, FleetChanges, FleetReport, PairOfFleet

NAMES = dict(zip(AXES, ("pitch", "yaw", "roll", "right", "down", "forward"), strict=True))
LEAST = {"deg": 0.1, "m": 0.02}
"""A plot reaches at least this far to each side, so that what is too small to be a drift does not look like one."""

WHERE_ALL_IS = (
    "`report.json` beside this page has them all; `coec fleet report RESULTS --sql` prints queries that ask for more."
)

DRIFTED = 1.0
"""From this urgency on, a drift is large enough that a monitor has to notice it."""

COMPARED = 2
"""Accepted windows that a drift takes: an earlier and a later one."""

PLOTTED, LISTED = 100, 1000
"""Pairs with a plot, and pairs after them with a row, so that the page stays below 3 MB whatever the fleet. All others
are summarised."""

ROWS = 200
"""Most rows of the other tables, for the same reason."""

PLOTTED_DAYS = 120
"""Most points of a plot, which is 180 px wide."""

BANDS = (1.0, 0.5, 0.25, 0.1, 0.0)
"""Lower ends of the bands of urgency in which pairs that are not listed are counted."""


def page(report: FleetReport, title: str, made: Provenance) -> Page:
    """The page; names of vehicles are text in it, never markup."""
    sections = []
    if report.changes is not None:
        sections.append(Section("Against the earlier batch", _changes(report.changes)))
    if report.false_alarms is not None:
        sections.append(Section("Alarms", _alarms(report.false_alarms)))
    sections.append(Section("Vehicles, the most urgent first", _vehicles(report.pairs)))
    if report.refusals or report.errors:
        counts = [*report.refusals.items(), *((f"{code} (no result)", n) for code, n in report.errors.items())]
        counts.sort(key=lambda item: (-item[1], item[0]))
        rows = [(Cell(code, code=True), str(n)) for code, n in counts[:ROWS]]
        caption = f"Windows by code of a reason; one window may have several.{_left_out(len(counts))}"
        table = Table(caption, ("Code", "Windows"), rows, frozenset({1}))
        sections.append(Section("Why windows were refused, or have no result", (table,)))
    if report.figures:
        sections.append(Section("Figures of accepted windows over the fleet", _figures(report)))
    return Page("coec fleet report", title, (_verdict(report),), (*sections, made.section()))


def _verdict(report: FleetReport) -> VerdictBanner:
    urgent = [pair for pair in report.pairs if pair.urgency >= DRIFTED]
    if not urgent:
        if all(pair.accepted < COMPARED for pair in report.pairs):
            todo = "Judge windows of other days, too: a drift is what lies between earlier windows and later ones."
            return VerdictBanner("none", "Drift not known.", sentence(report), (todo,))
        return VerdictBanner("good", "No drift.", sentence(report))
    first = f"{urgent[0].vehicle}/{urgent[0].pair}"
    todo = f"Look at {first} first: see that its mount is tight, and commission it again where the camera was moved."
    return VerdictBanner("unsure", "Drift.", sentence(report), (todo,))


def sentence(report: FleetReport) -> str:
    """The fleet in a sentence or two."""
    if report.first_ns is None or report.last_ns is None:
        return f"{count(report.windows, 'window')}, none with a result."
    drifted = sum(pair.urgency >= DRIFTED for pair in report.pairs)
    too_few = sum(pair.accepted < COMPARED for pair in report.pairs)
    first, last = day(report.first_ns), day(report.last_ns)
    when = f"on {first}" if first == last else f"from {first} to {last}"
    untold = f" Pairs with too few accepted windows to tell a drift: {too_few}." if too_few else ""
    accepted = f"{100.0 * report.accepted / max(report.windows, 1):.1f} % accepted"
    return (
        f"{count(report.vehicles, 'vehicle')}, {count(report.windows, 'window')} {when}, {accepted}. Pairs that have"
        f" drifted by what a monitor has to see, or more: {drifted} of {len(report.pairs)}.{untold}"
    )


def sentence_of_alarms(alarms: FalseAlarms) -> str:
    """How often pairs were accused without cause."""
    counted = (
        f"{count(alarms.pairs, 'pair')} watched for {alarms.watched_h:.1f} h of driving: alarms confirmed by another"
        f" extrinsic {alarms.confirmed}, false {alarms.withdrawn}"
    )
    if alarms.per_100_h is None or alarms.per_100_h_at_most is None:
        return f"{counted}."
    return f"{counted}, {alarms.per_100_h:.2f} in 100 h (95 %: at most {alarms.per_100_h_at_most:.2f})."


def _alarms(alarms: FalseAlarms) -> tuple[Block, ...]:
    summary = Text((sentence_of_alarms(alarms),))
    accused = sorted(alarms.by_pair.items(), key=lambda item: (-item[1], item[0]))
    if not accused:
        return (summary,)
    rows = [(name, str(number)) for name, number in accused[:ROWS]]
    caption = f"Pairs that were accused without cause.{_left_out(len(accused))}"
    return summary, Table(caption, ("Vehicle/pair", "False alarms"), rows, frozenset({1}))


def _changes(changes: FleetChanges) -> tuple[Block, ...]:
    summary = Text(
        (
            f"{count(changes.both, 'window is', 'windows are')} in both; {changes.identical} are decided the same "
            f"to the byte, {changes.newly_accepted} are newly accepted, {changes.newly_refused} newly refused,"
            f" {changes.newly_failing} have no result any more. Those accepted twice differ by"
            f" {figure(changes.rotation_deg)}° and {figure(changes.translation_m)} m (root mean square).",
        )
    )
    if not changes.windows:
        return (summary,)
    rows = [
        (each.vehicle, each.window_id, each.before, each.now, figure(each.rotation_deg), figure(each.translation_m))
        for each in changes.windows
    ]
    heads = ("Vehicle", "Window", "Before", "Now", "deg", "m")
    return summary, Table("Decided otherwise, those furthest apart first", heads, rows, frozenset({4, 5}))


def _vehicles(pairs: Sequence[PairOfFleet]) -> tuple[Block, ...]:
    """The most urgent pairs with a plot, the next ones without, and all others summarised."""
    drift, counted = ("Urgency", "Worst axis", "Drift", "Per 30 days"), ("Windows", "Accepted", "Last window")
    plotted, listed, others = pairs[:PLOTTED], pairs[PLOTTED : PLOTTED + LISTED], pairs[PLOTTED + LISTED :]
    explanation = (
        "Drift: where the last accepted windows are from where the first were. The plot shows that axis, day by day:"
        " median, and the band that holds two thirds of the windows. Urgency 1 is a step that a monitor has to see,"
        " 0.5° or 10 cm."
    )
    rows = [(*_drift(pair), _plot(pair), *_counts(pair)) for pair in plotted]
    of_all = count(len(pairs), "pair") if not listed else f"The first {PLOTTED} of {len(pairs)} pairs"
    heads = ("Vehicle", "Pair", *drift, "Day by day", *counted)
    blocks: list[Block] = [Text((explanation,), quiet=True), Table(of_all, heads, rows, frozenset({2, 4, 5, 7, 8}))]
    if listed:
        rows = [(*_drift(pair), *_counts(pair)) for pair in listed]
        caption = f"The next {len(listed)}, without plots"
        blocks.append(Table(caption, ("Vehicle", "Pair", *drift, *counted), rows, frozenset({2, 4, 5, 6, 7})))
    if others:
        blocks += _together(others)
    return tuple(blocks)


def _together(pairs: Sequence[PairOfFleet]) -> tuple[Block, ...]:
    """Pairs that are not listed one by one, by how urgent they are."""
    explanation = (
        f"{len(pairs)} pairs more are not listed one by one, as none of them is more urgent than those above. "
        f"{WHERE_ALL_IS}"
    )
    rows = []
    for low, high in zip(BANDS, (inf, *BANDS), strict=False):
        of_band = [pair for pair in pairs if low <= pair.urgency < high]
        if of_band:
            windows, accepted = sum(pair.windows for pair in of_band), sum(pair.accepted for pair in of_band)
            name = f"{low:g} and more" if high == inf else f"{low:g} to {high:g}"
            rows.append((name, str(len(of_band)), str(windows), percent(accepted / max(windows, 1))))
    heads = ("Urgency", "Pairs", "Windows", "Accepted")
    return Text((explanation,)), Table("All other pairs, by urgency", heads, rows, frozenset({1, 2, 3}))


def _left_out(total: int) -> str:
    """What a table says about rows that do not fit; begins with a space, or is empty."""
    return "" if total <= ROWS else f" {ROWS} of {total} rows. {WHERE_ALL_IS}"


def _drift(pair: PairOfFleet) -> Sequence[str | Cell]:
    """Vehicle, pair, and how far it has drifted."""
    worst = drift = slope = NONE
    if pair.worst is not None:
        axis, unit = AXES.index(pair.worst), pair.worst.rpartition("_")[2]
        shown = "°" if unit == "deg" else " m"
        per_month = pair.slope[axis]
        worst = NAMES[pair.worst]
        drift = f"{figure(pair.drift[axis], sign=True)}{shown}"
        slope = NONE if per_month is None else f"{figure(per_month, sign=True)}{shown}"
    urgency = Cell(f"{pair.urgency:.1f}", tone="bad" if pair.urgency >= DRIFTED else None)
    return (pair.vehicle, pair.pair, urgency, worst, drift, slope)


def _counts(pair: PairOfFleet) -> tuple[str, str, str]:
    """Windows, those accepted, and the day of the last one."""
    return str(pair.windows), str(pair.accepted), NONE if pair.last_ns is None else day(pair.last_ns)


def _plot(pair: PairOfFleet) -> str | Cell:
    """Median and band of the worst axis over the days, about the first day; of many days only every second, third, ...
    and the last."""
    if pair.worst is None:
        return NONE
    axis, unit = AXES.index(pair.worst), pair.worst.rpartition("_")[2]
    step = -(-len(pair.days) // PLOTTED_DAYS) or 1
    days = pair.days[::-1][::step][::-1]
    points = tuple(
        (datetime.fromisoformat(of_day.date).timestamp(), low, middle, high)
        for of_day in days
        if (low := of_day.low[axis]) is not None
        and (middle := of_day.middle[axis]) is not None
        and (high := of_day.high[axis]) is not None
    )
    title = f"{pair.vehicle} {pair.pair}, {NAMES[pair.worst]} day by day"
    return Cell("", trend=Trend(title, points, points[0][2], LEAST[unit])) if points else NONE


def _figures(report: FleetReport) -> tuple[Block, ...]:
    rows: list[Sequence[str | Cell]] = [
        (
            Cell(each.name, code=True),
            each.pair,
            str(each.vehicles),
            str(each.windows),
            *(figure(value) for value in (each.low, each.middle, each.high)),
        )
        for each in report.figures[:ROWS]
    ]
    heads = ("Figure", "Pair", "Vehicles", "Windows", "0.5 %", "Median", "99.5 %")
    explanation = (
        "99 of 100 windows lie between the outer two. A vehicle without a baseline of its own can be held against them."
    )
    return Text((explanation,), quiet=True), Table(
        f"Figures by pair.{_left_out(len(report.figures))}", heads, rows, frozenset({2, 3, 4, 5, 6})
    )
