"""The page of a fleet: one HTML file with everything in it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from coec.reports.console import figure
from coec.reports.instants import day
from coec.reports.page import Block, Cell, Page, Section, Table, Text, Trend, Verdict
from coec.reports.page.words import count
from coec.reports.provenance import Made
from coec.schemas.fleet import AXES, DayOfPair, FalseAlarms, FleetChanges, FleetReport, PairOfFleet

NAMES = dict(zip(AXES, ("pitch", "yaw", "roll", "right", "down", "forward"), strict=True))
LEAST = {"deg": 0.1, "m": 0.02}
"""Half of the least height of a plot: what is smaller is no drift, and shall not look like one."""

DRIFTED = 1.0
"""Urgency from which on a drift is one that a monitor has to see."""


def page(report: FleetReport, title: str, made: Made) -> Page:
    """The page; what vehicles call themselves is text in it."""
    sections = []
    if report.changes is not None:
        sections.append(Section("Against the earlier batch", _changes(report.changes)))
    if report.false_alarms is not None:
        sections.append(Section("Alarms", _alarms(report.false_alarms)))
    sections.append(Section("Vehicles, the most urgent first", _vehicles(report.pairs)))
    if report.refusals or report.errors:
        counts = [*report.refusals.items(), *((f"{code} (no result)", n) for code, n in report.errors.items())]
        counts.sort(key=lambda item: (-item[1], item[0]))
        rows = [(Cell(code, code=True), str(n)) for code, n in counts]
        told = "Windows by code of a reason; one window may have several."
        table = Table(told, ("Code", "Windows"), rows, frozenset({1}))
        sections.append(Section("Why windows were refused, or have no result", (table,)))
    if report.figures:
        sections.append(Section("Figures of accepted windows over the fleet", _figures(report)))
    return Page("coec fleet report", title, (_verdict(report),), (*sections, made.section()))


def _verdict(report: FleetReport) -> Verdict:
    urgent = [pair for pair in report.pairs if pair.urgency >= DRIFTED]
    if not urgent:
        return Verdict("none" if report.first_ns is None else "good", "No drift.", sentence(report))
    first = f"{urgent[0].vehicle}/{urgent[0].pair}"
    todo = f"Look at {first} first: see that its mount is tight, and commission it again where the camera was moved."
    return Verdict("unsure", "Drift.", sentence(report), (todo,))


def sentence(report: FleetReport) -> str:
    """The whole in a sentence or two."""
    if report.first_ns is None or report.last_ns is None:
        return f"{report.windows} windows, none with a result."
    drifted = sum(pair.urgency >= 1.0 for pair in report.pairs)
    share = 100.0 * report.accepted / max(report.windows, 1)
    return (
        f"{report.vehicles} vehicles, {report.windows} windows from {day(report.first_ns)} to {day(report.last_ns)},"
        f" {share:.1f} % accepted. {drifted} of {len(report.pairs)} pairs have drifted by what a monitor has to see,"
        " or more."
    )


def sentence_of_alarms(alarms: FalseAlarms) -> str:
    """How often pairs were accused without cause."""
    counted = (
        f"{alarms.pairs} pairs were watched for {alarms.watched_h:.1f} h of driving: {alarms.confirmed} alarms were"
        f" confirmed by another extrinsic, {alarms.withdrawn} were false"
    )
    if alarms.per_100_h is None or alarms.per_100_h_at_most is None:
        return f"{counted}."
    return f"{counted}, {alarms.per_100_h:.2f} in 100 h (95 %: at most {alarms.per_100_h_at_most:.2f})."


def _alarms(alarms: FalseAlarms) -> tuple[Block, ...]:
    told = Text((sentence_of_alarms(alarms),))
    rows = [(name, str(number)) for name, number in alarms.by_pair.items()]
    if not rows:
        return (told,)
    return told, Table("Pairs that were accused without cause", ("Vehicle/pair", "False alarms"), rows, frozenset({1}))


def _changes(changes: FleetChanges) -> tuple[Block, ...]:
    told = Text(
        (
            f"{changes.both} windows are in both; {changes.identical} are decided the same to the byte,"
            f" {changes.newly_accepted} are newly accepted, {changes.newly_refused} newly refused,"
            f" {changes.newly_failing} have no result any more. Those accepted twice differ by"
            f" {figure(changes.rotation_deg)}° and {figure(changes.translation_m)} m (root mean square).",
        )
    )
    if not changes.windows:
        return (told,)
    rows = [
        (each.vehicle, each.window_id, each.before, each.now, figure(each.rotation_deg), figure(each.translation_m))
        for each in changes.windows
    ]
    heads = ("Vehicle", "Window", "Before", "Now", "deg", "m")
    return told, Table("Decided otherwise, those furthest apart first", heads, rows, frozenset({4, 5}))


def _vehicles(pairs: Sequence[PairOfFleet]) -> tuple[Block, ...]:
    drift = ("Urgency", "Worst axis", "Drift", "Per 30 days", "Day by day")
    heads = ("Vehicle", "Pair", *drift, "Windows", "Accepted", "Last window")
    told = (
        "Drift: where the last accepted windows are from where the first were. The plot shows that axis, day by day:"
        " median, and the band that holds two thirds of the windows. Urgency 1 is a step that a monitor has to see,"
        " 0.5° or 10 cm."
    )
    rows = [_pair(pair) for pair in pairs]
    return Text((told,), quiet=True), Table(count(len(pairs), "pair"), heads, rows, frozenset({2, 4, 5, 7, 8}))


def _pair(pair: PairOfFleet) -> Sequence[str | Cell]:
    worst = drift = slope = "–"
    plot: str | Cell = "–"
    if pair.worst is not None:
        axis, unit = AXES.index(pair.worst), pair.worst.rpartition("_")[2]
        shown = "°" if unit == "deg" else " m"
        per_month = pair.slope[axis]
        worst = NAMES[pair.worst]
        drift = f"{figure(pair.drift[axis], sign=True)}{shown}"
        slope = "–" if per_month is None else f"{figure(per_month, sign=True)}{shown}"
        plot = _plot(pair.days, axis, LEAST[unit], f"{pair.vehicle} {pair.pair}, {worst} day by day")
    last = "–" if pair.last_ns is None else day(pair.last_ns)
    urgency = Cell(f"{pair.urgency:.1f}", tone="bad" if pair.urgency >= DRIFTED else None)
    counts = (str(pair.windows), str(pair.accepted))
    return (pair.vehicle, pair.pair, urgency, worst, drift, slope, plot, *counts, last)


def _plot(days: Sequence[DayOfPair], axis: int, least: float, title: str) -> str | Cell:
    """Median and band of one axis over the days, about the first of them."""
    told = tuple(
        (datetime.fromisoformat(of_day.date).timestamp(), low, middle, high)
        for of_day in days
        if (low := of_day.low[axis]) is not None
        and (middle := of_day.middle[axis]) is not None
        and (high := of_day.high[axis]) is not None
    )
    return Cell("", trend=Trend(title, told, told[0][2], least)) if told else "–"


def _figures(report: FleetReport) -> tuple[Block, ...]:
    rows: list[Sequence[str | Cell]] = [
        (
            Cell(each.name, code=True),
            each.pair,
            str(each.vehicles),
            str(each.windows),
            *(figure(value) for value in (each.low, each.middle, each.high)),
        )
        for each in report.figures
    ]
    heads = ("Figure", "Pair", "Vehicles", "Windows", "0.5 %", "Median", "99.5 %")
    told = (
        "99 of 100 windows lie between the outer two. A vehicle without a baseline of its own can be held against them."
    )
    return Text((told,), quiet=True), Table("Figures by pair", heads, rows, frozenset({2, 3, 4, 5, 6}))
