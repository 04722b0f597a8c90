"""The page of a red event: what happened, what was seen, what was decided and why. It loads nothing but the pictures
beside it, and whatever a vehicle says is text in it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape

from coec.reports import html
from coec.reports.console import AXIS_NAMES, UNITS, figure
from coec.schemas.incident import Absent, FetchedWindow, IncidentReport
from coec.schemas.replies import (
    CalibrationResult,
    EvidenceEvent,
    ExtrinsicReply,
    HealthReply,
    HistoryReply,
    MetricsPoint,
    Reason,
    StatusReply,
)

NS_PER_S = 1_000_000_000

WIDTH, HEIGHT, MARGIN = 640, 48, 3
"""Of the plot of a figure, px."""

STATE_HEIGHT = 14
"""Of the strip of states, px."""

COLOURS = {
    "healthy": "#2e7d32",
    "suspect": "#f9a825",
    "degraded": "#ef6c00",
    "miscalibrated": "#c62828",
    "stale": "#757575",
    "unknown": "#9e9e9e",
}

MAX_PLOTS = 16
"""Figures that are drawn; a vehicle says how many it has."""


@dataclass(frozen=True, slots=True)
class Story:
    """What came; None where it did not."""

    event: EvidenceEvent
    history: HistoryReply | None
    health: HealthReply | None
    extrinsic: ExtrinsicReply | None
    status: StatusReply | None
    windows: tuple[FetchedWindow, ...]
    absent: tuple[Absent, ...]
    chain_holds: bool | None
    snippets: tuple[str, ...] = ()


def page(story: Story, pictures: Sequence[str]) -> str:
    """The document; `pictures` are names of files beside it."""
    event = story.event
    title = f"{event.vehicle}/{event.pair}: {', '.join(reason.code for reason in event.reasons) or 'red event'}"
    parts = [html.head(title), *(f"<p>{escape(each)}</p>" for each in sentences(story))]
    if pictures:
        parts.append("<h2>What the camera saw: at the calibration that was served, and at the true one since</h2>")
        parts += [
            f"<figure><img src='{escape(name, quote=True)}' alt='{escape(name)}'><figcaption>{escape(name)}"
            "</figcaption></figure>"
            for name in pictures
        ]
    parts += ["<h2>Figures around the event</h2>", *_timeline(event)]
    results = () if story.history is None else story.history.results
    if results:
        parts += ["<h2>What was decided, and why</h2>", _results(results, event)]
        parts += [each for result in results for each in _refusal(result)]
    if story.history is not None and story.history.entries:
        parts += ["<h2>What happened, in the vehicle's history</h2>", _chain(story), _entries(story.history)]
    parts += ["<h2>Recordings</h2>", _windows(story.windows), _snippets(story.snippets)]
    if story.health is not None:
        parts += ["<h2>Since then</h2>", *_now(story, story.health)]
    if story.absent:
        parts.append("<h2>What is not here</h2>")
        parts.append(html.table(("what", "why"), ((escape(a.what), escape(a.why)) for a in story.absent), set()))
    return "\n".join((*parts, "</html>"))


def sentences(story: Story) -> Iterable[str]:
    """The story in a few sentences, each of which a document in the folder bears out."""
    event = story.event
    began = f"At {instant(event.stamp_ns)} of sensor time the pair {event.pair} of {event.vehicle} turned red"
    yield f"{began} (by the vehicle's clock {instant(event.wall_ns)}). {_said(event.reasons)}"
    decided = {result.window_id: result for result in (story.history.results if story.history else ())}
    for window_id, when in ((event.window_before, "before"), (event.window_after, "after")):
        if window_id is None:
            yield f"There is no window {when} it."
        elif window_id in decided:
            result = decided[window_id]
            why = f": {_said(result.verdict.reasons)}" if result.verdict.reasons else "."
            verdict = f"{result.verdict.decision}{why}"
            yield f"The window {when} it, {window_id}, holds {result.pairs} pairs and was {verdict}"
        else:
            yield f"The window {when} it is {window_id}; nothing is told of what was decided of it."
    if event.resolution is not None:
        end = "" if event.resolved_stamp_ns is None else f" after {_span(event.resolved_stamp_ns - event.stamp_ns)}"
        yield f"It ended{end}: {event.resolution}"
    else:
        yield "It had not ended when this was fetched."


def sentence(report: IncidentReport) -> str:
    """What came, in one line."""
    size = sum(file.size_bytes for file in report.files) / 1e6
    verified = sum(window.in_history is True for window in report.windows)
    return (
        f"{len(report.files)} files, {size:.1f} MB, {len(report.windows)} windows with the right sha256, "
        f"{verified} with the result that the history holds"
    )


def instant(stamp_ns: int) -> str:
    """UTC, to the second; a number that is no time stays a number."""
    try:
        return f"{datetime.fromtimestamp(stamp_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S}Z"
    except (ValueError, OverflowError, OSError):
        return f"{stamp_ns} ns"


def _said(reasons: Sequence[Reason]) -> str:
    return " ".join(f"{reason.text} ({reason.code})" for reason in reasons) or "No reason was given."


def _span(nanoseconds: int) -> str:
    seconds = nanoseconds / NS_PER_S
    return f"{seconds:.0f} s" if abs(seconds) < 120 else f"{seconds / 60:.0f} min"


def _timeline(event: EvidenceEvent) -> Iterable[str]:
    """The states as a strip, and each figure under it on the same axis of time; the event is a line through all."""
    points = event.metrics
    if not points:
        yield "<p class=quiet>No figures are kept of it.</p>"
        return
    first, last = points[0].stamp_ns, max(points[-1].stamp_ns, event.stamp_ns)
    states = " ".join(dict.fromkeys(point.state for point in points))
    yield (
        f"<p class=quiet>{len(points)} checks, {instant(first)} to {instant(last)}; states: {escape(states)}. The line "
        "is the event.</p>"
    )
    yield _strip(points, event, first, last)
    names = sorted({name for point in points for name in point.metrics})
    for name in names[:MAX_PLOTS]:
        told = [(point.stamp_ns, value) for point in points if (value := point.metrics.get(name)) is not None]
        if told:
            values = [value for _, value in told]
            ends = f"{figure(min(values))} to {figure(max(values))}"
            yield f"<p class=quiet>{escape(name)}: {ends}</p>{_plot(name, told, event, first, last)}"
    if len(names) > MAX_PLOTS:
        yield f"<p class=quiet>{len(names) - MAX_PLOTS} figures more are in event.json.</p>"


def _x(stamp_ns: int, first: int, last: int) -> float:
    share = (stamp_ns - first) / (last - first) if last > first else 0.5
    return MARGIN + (WIDTH - 2 * MARGIN) * min(max(share, 0.0), 1.0)


def _strip(points: Sequence[MetricsPoint], event: EvidenceEvent, first: int, last: int) -> str:
    ends = [*(point.stamp_ns for point in points[1:]), last]
    bars = "".join(
        f"<rect x={_x(point.stamp_ns, first, last):.1f} y=0 height={STATE_HEIGHT} "
        f"width={max(_x(end, first, last) - _x(point.stamp_ns, first, last), 1.0):.1f} fill='{COLOURS[point.state]}'>"
        f"<title>{escape(point.state)}</title></rect>"
        for point, end in zip(points, ends, strict=True)
    )
    return (
        f"<svg width={WIDTH} height={STATE_HEIGHT} role=img aria-label='state'>{bars}"
        f"{_mark(event, first, last, STATE_HEIGHT)}</svg>"
    )


def _plot(name: str, told: Sequence[tuple[int, float]], event: EvidenceEvent, first: int, last: int) -> str:
    low, high = min(value for _, value in told), max(value for _, value in told)
    reach = (high - low) or 1.0
    line = " ".join(
        f"{_x(stamp_ns, first, last):.1f},{HEIGHT - MARGIN - (HEIGHT - 2 * MARGIN) * (value - low) / reach:.1f}"
        for stamp_ns, value in told
    )
    return (
        f"<svg width={WIDTH} height={HEIGHT} role=img aria-label='{escape(name, quote=True)}'>"
        f"<polyline points='{line}' />{_mark(event, first, last, HEIGHT)}</svg>"
    )


def _mark(event: EvidenceEvent, first: int, last: int, height: int) -> str:
    x = f"{_x(event.stamp_ns, first, last):.1f}"
    return f"<line class=zero x1={x} x2={x} y1=0 y2={height} />"


def _results(results: Sequence[CalibrationResult], event: EvidenceEvent) -> str:
    def rows() -> Iterable[Sequence[str]]:
        for result in results:
            when = "after" if result.data_stamp_ns > event.stamp_ns else "before"
            moved = [
                f"{figure(value, 2 if unit == 'deg' else 3, sign=True)} ± {figure(sigma, 2 if unit == 'deg' else 3)}"
                for value, sigma, unit in zip(result.correction, result.sigma, UNITS, strict=True)
            ]
            verdict = escape(result.verdict.decision)
            shown = verdict if verdict == "accepted" else f"<span class=bad>{verdict}</span>"
            yield (instant(result.data_stamp_ns), when, escape(result.window_id), str(result.pairs), shown, *moved)

    heads = [f"{name} [{unit}]" for name, unit in zip(AXIS_NAMES, UNITS, strict=True)]
    return html.table(
        ("data until", "the event", "window", "pairs", "verdict", *heads), rows(), set(range(5, 11)) | {3}
    )


def _refusal(result: CalibrationResult) -> Iterable[str]:
    """Why a window was refused, and the figures that did not keep their limits."""
    if result.verdict.decision == "accepted":
        return
    failed = [
        f"{name} {figure(metric.value)} ({'≥' if metric.at_least else '≤'} {figure(metric.limit)} asked)"
        for name, metric in sorted(result.metrics.items())
        if metric.limit is not None and not metric.passed
    ]
    because = f" Beyond their limits: {', '.join(failed)}." if failed else ""
    yield f"<p>{escape(f'{result.window_id} was refused: {_said(result.verdict.reasons)}{because}')}</p>"


def _chain(story: Story) -> str:
    if story.chain_holds is None:
        return "<p class=quiet>The hashes of these entries could not be checked here.</p>"
    if story.chain_holds:
        return "<p class=quiet>Each entry is what its hash says, and holds the hash of the one before it.</p>"
    return "<p class=bad>The hashes of these entries do not fit: something was changed, taken out or put in.</p>"


def _entries(history: HistoryReply) -> str:
    rows = (
        (
            str(item.entry.sequence),
            instant(item.entry.wall_ns),
            "-" if item.entry.stamp_ns is None else instant(item.entry.stamp_ns),
            escape(item.entry.kind),
            escape(item.entry.code),
            escape(item.entry.text),
            escape(item.entry.sender or ""),
            escape(item.sha256[:12]),
        )
        for item in history.entries
    )
    heads = ("#", "vehicle's clock", "sensor time", "what", "outcome", "why", "who", "sha256")
    return html.table(heads, rows, {0})


def _windows(windows: Sequence[FetchedWindow]) -> str:
    if not windows:
        return "<p>None was fetched.</p>"
    told = {True: "the one in the history", False: "<span class=bad>not the one in the history</span>", None: "-"}
    rows = (
        (
            f"<a href='windows/{escape(window.window_id, quote=True)}.mcap'>{escape(window.window_id)}</a>",
            "-" if window.pairs is None else str(window.pairs),
            f"{window.size_bytes / 1e6:.1f}",
            escape(window.decision or "not evaluated"),
            told[window.in_history],
            f"verified, {escape(window.sha256[:16])}…",
        )
        for window in windows
    )
    return html.table(("window", "pairs", "MB", "verdict", "its result is", "sha256"), rows, {1, 2}) + (
        "<p class=quiet>They open in Foxglove, Lichtblick and ROS 2 tools; <code>coec replay windows/ID.mcap</code> "
        "reaches the recorded decision again.</p>"
    )


def _snippets(snippets: Sequence[str]) -> str:
    if not snippets:
        return ""
    links = ", ".join(f"<a href='windows/{escape(one, quote=True)}.mcap'>{escape(one)}</a>" for one in snippets)
    return f"<p>Every frame of the seconds about the event: {links}.</p>"


def _now(story: Story, health: HealthReply) -> Iterable[str]:
    served = "" if story.extrinsic is None else f" Served: {story.extrinsic.provenance}."
    why = f" {_said(health.reasons)}" if health.reasons else ""
    version = "" if story.status is None else f" The service is coec {story.status.version}."
    text = f"When this was fetched the pair was {health.state}, since {instant(health.since_ns)}.{why}{served}{version}"
    yield f"<p>{escape(text)}</p>"
