"""The page of a fleet: one HTML file with everything in it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from html import escape

from coec.reports import html
from coec.reports.console import figure
from coec.schemas.fleet import AXES, DayOfPair, FalseAlarms, FleetChanges, FleetReport, PairOfFleet

NS_PER_S = 1_000_000_000

NAMES = dict(zip(AXES, ("pitch", "yaw", "roll", "right", "down", "forward"), strict=True))
LEAST = {"deg": 0.1, "m": 0.02}
"""Half of the least height of a plot: what is smaller is no drift, and shall not look like one."""

WIDTH, HEIGHT, MARGIN = 220, 44, 3
"""Of a plot, px."""


def page(report: FleetReport, title: str) -> str:
    """The document. It loads nothing, and what vehicles call themselves is text in it."""
    parts = [
        html.head(title),
        f"<p>{escape(sentence(report))}</p>",
    ]
    if report.changes is not None:
        parts += ["<h2>Against the earlier batch</h2>", *_changes(report.changes)]
    if report.false_alarms is not None:
        alarms = report.false_alarms
        parts += ["<h2>Alarms</h2>", f"<p>{escape(sentence_of_alarms(alarms))}</p>"]
        parts.append(
            html.table(("vehicle/pair", "false alarms"), ((escape(n), str(c)) for n, c in alarms.by_pair.items()), {1})
        )
    parts += [
        "<h2>Vehicles, the most urgent first</h2>",
        "<p class=quiet>Drift: where the last accepted windows are from where the first were. The plot shows that"
        " axis, day by day: median, and the band that holds two thirds of the windows. Urgency 1 is a step that a"
        " monitor has to see, 0.5° or 10 cm.</p>",
        html.table(
            (
                "vehicle",
                "pair",
                "windows",
                "accepted",
                "last window",
                "worst axis",
                "drift",
                "per 30 days",
                "urgency",
                "",
            ),
            (_pair(pair) for pair in report.pairs),
            {2, 3, 6, 7, 8},
        ),
    ]
    if report.refusals or report.errors:
        parts.append("<h2>Why windows were refused, or have no result</h2>")
        counts = [*report.refusals.items(), *((f"{code} (no result)", n) for code, n in report.errors.items())]
        counts.sort(key=lambda item: (-item[1], item[0]))
        parts.append(html.table(("code", "windows"), ((escape(code), str(n)) for code, n in counts), {1}))
    if report.figures:
        parts += [
            "<h2>Figures of accepted windows over the fleet</h2>",
            "<p class=quiet>99 of 100 windows lie between the outer two. A vehicle without a baseline of its own can be"
            " held against them.</p>",
            html.table(
                ("figure", "pair", "vehicles", "windows", "0.5 %", "median", "99.5 %"),
                (
                    (
                        escape(each.name),
                        escape(each.pair),
                        str(each.vehicles),
                        str(each.windows),
                        *(figure(value) for value in (each.low, each.middle, each.high)),
                    )
                    for each in report.figures
                ),
                {2, 3, 4, 5, 6},
            ),
        ]
    return "\n".join((*parts, "</html>"))


def sentence(report: FleetReport) -> str:
    """The whole in a sentence or two."""
    if report.first_ns is None or report.last_ns is None:
        return f"{report.windows} windows, none with a result."
    drifted = sum(pair.urgency >= 1.0 for pair in report.pairs)
    share = 100.0 * report.accepted / max(report.windows, 1)
    return (
        f"{report.vehicles} vehicles, {report.windows} windows from {_day(report.first_ns)} to {_day(report.last_ns)},"
        f" {share:.1f} % accepted. {drifted} of {len(report.pairs)} pairs have drifted by what a monitor has to see,"
        " or more."
    )


def _day(stamp_ns: int) -> str:
    return f"{datetime.fromtimestamp(stamp_ns // NS_PER_S, UTC):%Y-%m-%d}"


def sentence_of_alarms(alarms: FalseAlarms) -> str:
    """How often pairs were accused without cause."""
    counted = (
        f"{alarms.pairs} pairs were watched for {alarms.watched_h:.1f} h of driving: {alarms.confirmed} alarms were"
        f" confirmed by another extrinsic, {alarms.withdrawn} were false"
    )
    if alarms.per_100_h is None or alarms.per_100_h_at_most is None:
        return f"{counted}."
    return f"{counted}, {alarms.per_100_h:.2f} in 100 h (95 %: at most {alarms.per_100_h_at_most:.2f})."


def _changes(changes: FleetChanges) -> Iterable[str]:
    yield (
        f"<p>{changes.both} windows are in both; {changes.identical} are decided the same to the byte,"
        f" {changes.newly_accepted} are newly accepted, {changes.newly_refused} newly refused,"
        f" {changes.newly_failing} have no result any more. Those accepted twice differ by"
        f" {figure(changes.rotation_deg)}° and {figure(changes.translation_m)} m (root mean square).</p>"
    )
    if changes.windows:
        yield html.table(
            ("vehicle", "window", "before", "now", "deg", "m"),
            (
                (
                    escape(each.vehicle),
                    escape(each.window_id),
                    escape(each.before),
                    escape(each.now),
                    figure(each.rotation_deg),
                    figure(each.translation_m),
                )
                for each in changes.windows
            ),
            {4, 5},
        )


def _pair(pair: PairOfFleet) -> Sequence[str]:
    if pair.worst is None:
        worst = drift = slope = plot = "-"
    else:
        axis, unit = AXES.index(pair.worst), pair.worst.rpartition("_")[2]
        shown = "°" if unit == "deg" else " m"
        per_month = pair.slope[axis]
        worst = NAMES[pair.worst]
        drift = f"{figure(pair.drift[axis], sign=True)}{shown}"
        slope = "-" if per_month is None else f"{figure(per_month, sign=True)}{shown}"
        plot = _plot(pair.days, axis, LEAST[unit], f"{pair.vehicle} {pair.pair}, {worst} day by day")
    last = "-" if pair.last_ns is None else _day(pair.last_ns)
    urgency = f"<span class=bad>{pair.urgency:.1f}</span>" if pair.urgency >= 1.0 else f"{pair.urgency:.1f}"
    counts = (str(pair.windows), str(pair.accepted))
    return (escape(pair.vehicle), escape(pair.pair), *counts, last, worst, drift, slope, urgency, plot)


def _plot(days: Sequence[DayOfPair], axis: int, least: float, title: str) -> str:
    """Median and band of one axis over the days, about the first of them."""
    told = [
        (datetime.fromisoformat(day.date).timestamp(), low, middle, high)
        for day in days
        if (low := day.low[axis]) is not None
        and (middle := day.middle[axis]) is not None
        and (high := day.high[axis]) is not None
    ]
    if not told:
        return "-"
    begin, end = told[0][0], told[-1][0]
    zero = told[0][2]
    reach = max(least, *(max(abs(low - zero), abs(high - zero)) for _, low, _, high in told))

    def at(time_s: float, value: float) -> str:
        x = MARGIN + (WIDTH - 2 * MARGIN) * ((time_s - begin) / (end - begin) if end > begin else 0.5)
        y = HEIGHT / 2 - (HEIGHT / 2 - MARGIN) * (value - zero) / reach
        return f"{x:.1f},{y:.1f}"

    lower = [at(time_s, low) for time_s, low, _, _ in told]
    upper = [at(time_s, high) for time_s, _, _, high in told]
    line = " ".join(at(time_s, middle) for time_s, _, middle, _ in told)
    return (
        f"<svg width={WIDTH} height={HEIGHT} role=img aria-label='{escape(title)}'><title>{escape(title)}</title>"
        f"<line class=zero x1=0 x2={WIDTH} y1={HEIGHT / 2} y2={HEIGHT / 2} />"
        f"<polygon points='{' '.join((*lower, *reversed(upper)))}' /><polyline points='{line}' /></svg>"
    )
