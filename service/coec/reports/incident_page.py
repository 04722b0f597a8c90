"""The page of an incident: what happened, what was seen, what was decided and why. Whatever a vehicle says is shown as
text, never as markup."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from coec.reports.charts import Chart, Ground, Mark, Series
from coec.reports.console import AXIS_NAMES, UNITS, figure
from coec.reports.formatting import NS_PER_S, count, second
from coec.reports.page import Block, Cell, Charts, Page, Picture, Pictures, Section, Table, Text, Tone, VerdictBanner
from coec.reports.page_parts import TONES, Provenance, advice_of, axis_value, title_of
from coec.reports.replies import entry_text
from coec.schemas import replies
from coec.schemas.documents import Absent, FetchedWindow, IncidentReport

MAX_PLOTS = 16
"""Most figures that are drawn, because a vehicle decides how many it sends."""

PICTURED = {
    "before.jpg": (
        "Before",
        "The window before the event: LiDAR points, or outlines, at what was served when the pair turned red, and, "
        "once a window after it told where the camera is, at that beside it.",
    ),
    "after.jpg": (
        "After",
        "The window after the event, at the same two extrinsics: the one that fits here and not above is the mount "
        "that moved.",
    ),
}
"""Name and caption of a picture by its file."""


@dataclass(frozen=True, slots=True)
class FetchedIncident:
    """What was fetched; None for what could not be."""

    event: replies.EvidenceEvent
    history: replies.HistoryReply | None
    health: replies.HealthReply | None
    extrinsic: replies.ExtrinsicReply | None
    status: replies.StatusReply | None
    windows: tuple[FetchedWindow, ...]
    absent: tuple[Absent, ...]
    chain_holds: bool | None
    snippets: tuple[str, ...] = ()


SAW = "What the camera saw: at the calibration that was served, and at the true one since"


def page(incident: FetchedIncident, pictures: Mapping[str, bytes], made: Provenance) -> Page:
    """The page; `pictures` are the files beside it, by name."""
    event = incident.event
    codes = ", ".join(reason.code for reason in event.reasons) or "incident"
    results = () if incident.history is None else incident.history.results
    entries = () if incident.history is None else incident.history.entries
    sections = [
        *((Section(SAW, _pictures(pictures)),) if pictures else ()),
        Section("Figures around the event", tuple(_timeline(event))),
        *((Section("What was decided, and why", (_results(results, event), *_refusals(results))),) if results else ()),
        *(
            (Section("What happened, in the vehicle’s history", (_chain(incident), _entries(entries))),)
            if entries
            else ()
        ),
        Section("Recordings", (*_windows(incident.windows), *_snippets(incident.snippets))),
    ]
    if incident.health is not None:
        sections.append(Section("Since then", (_now(incident, incident.health),)))
    if incident.absent:
        rows = [(absent.what, absent.why) for absent in incident.absent]
        sections.append(
            Section("What is not here", (Table("Asked for, and not had", ("What", "Why"), rows, prose=frozenset({1})),))
        )
    sections.append(made.section((("Event", event.event_id),)))
    lines = list(sentences(incident))
    opening = (_verdict(incident), Text(tuple(lines[1:])))
    return Page("coec fetch", f"{event.vehicle}/{event.pair}: {codes}", opening, tuple(sections))


def sentences(incident: FetchedIncident) -> Iterable[str]:
    """The story in a few sentences, each backed by a document in the folder."""
    event = incident.event
    began = f"At {second(event.stamp_ns)} of sensor time the pair {event.pair} of {event.vehicle} turned red"
    yield f"{began} (by the vehicle's clock {second(event.wall_ns)}). {_reasons_text(event.reasons)}"
    decided = {result.window_id: result for result in (incident.history.results if incident.history else ())}
    for window_id, when in ((event.window_before, "before"), (event.window_after, "after")):
        if window_id is None:
            yield f"There is no window {when} it."
        elif window_id in decided:
            result = decided[window_id]
            why = f": {_reasons_text(result.verdict.reasons)}" if result.verdict.reasons else "."
            verdict = f"{result.verdict.decision}{why}"
            yield f"The window {when} it, {window_id}, holds {count(result.pairs, 'pair')} and was {verdict}"
        else:
            yield f"The window {when} it is {window_id}; nothing is told of what was decided of it."
    if event.resolution is not None:
        end = "" if event.resolved_stamp_ns is None else f" after {_span(event.resolved_stamp_ns - event.stamp_ns)}"
        yield f"It ended{end}: {event.resolution}"
    else:
        yield "It had not ended when this was fetched."


def sentence(report: IncidentReport) -> str:
    """What was fetched, in one line."""
    size = sum(file.size_bytes for file in report.files) / 1e6
    verified = sum(window.in_history is True for window in report.windows)
    return (
        f"{count(len(report.files), 'file')}, {size:.1f} MB, {count(len(report.windows), 'window')} with the right "
        f"sha256, {verified} with the result that the history holds"
    )


def _verdict(incident: FetchedIncident) -> VerdictBanner:
    """What happened, by the first of `sentences`, and what to do; the tone depends on whether the event has ended."""
    resolved = incident.event.resolution is not None
    tone: Tone = "unsure" if resolved else "bad"
    return VerdictBanner(
        tone, "Over." if resolved else "Red.", next(iter(sentences(incident))), advice_of(incident.event.reasons)
    )


def _reasons_text(reasons: Sequence[replies.Reason]) -> str:
    return " ".join(f"{reason.text} ({reason.code})" for reason in reasons) or "No reason was given."


def _span(nanoseconds: int) -> str:
    seconds = nanoseconds / NS_PER_S
    return f"{seconds:.0f} s" if abs(seconds) < 120 else f"{seconds / 60:.0f} min"


def _pictures(pictures: Mapping[str, bytes]) -> tuple[Block, ...]:
    shown = [
        Picture(data, f"Camera image with LiDAR points, {PICTURED[name][0].lower()} the event", PICTURED[name][1], name)
        for name, data in pictures.items()
    ]
    return (Pictures(tuple(shown)),)


# --- figures --------------------------------------------------------------------------------------------------------


def _timeline(event: replies.EvidenceEvent) -> Iterable[Block]:
    """All figures over the same time axis, with the states of health as background and the event as a line."""
    points = event.metrics
    if not points:
        yield Text(("No figures are kept of it.",), quiet=True)
        return
    first, last = points[0].stamp_ns, points[-1].stamp_ns
    states = " ".join(dict.fromkeys(point.state for point in points))
    names = sorted({name for point in points for name in point.metrics})
    grounds = tuple(_grounds(points, event))
    charts = [_chart(name, points, event, grounds) for name in names[:MAX_PLOTS]]
    plotted = tuple(chart for chart in charts if chart is not None)
    meaning = (
        "The dashed line is the event, the ground the state of health." if plotted else "They hold no figures to draw."
    )
    checks = f"{count(len(points), 'check')}, {second(first)} to {second(last)}"
    yield Text((f"{checks}; states: {states}. {meaning}",), quiet=True)
    yield Charts(plotted, small=True)
    if len(names) > MAX_PLOTS:
        yield Text((f"{len(names) - MAX_PLOTS} figures more are in event.json.",), quiet=True)


def _seconds(stamp_ns: int, event: replies.EvidenceEvent) -> float:
    return (stamp_ns - event.stamp_ns) / NS_PER_S


def _grounds(points: Sequence[replies.MetricsPoint], event: replies.EvidenceEvent) -> Iterable[Ground]:
    ends = [*(point.stamp_ns for point in points[1:]), max(points[-1].stamp_ns, event.stamp_ns)]
    spans = [(point.state, point.stamp_ns, end) for point, end in zip(points, ends, strict=True)]
    for state, of_state in groupby(spans, key=lambda span: span[0]):
        every = list(of_state)
        yield Ground(_seconds(every[0][1], event), _seconds(every[-1][2], event), TONES.get(state, "none"), state)


def _chart(
    name: str, points: Sequence[replies.MetricsPoint], event: replies.EvidenceEvent, grounds: tuple[Ground, ...]
) -> Chart | None:
    samples = [
        (_seconds(point.stamp_ns, event), value) for point in points if (value := point.metrics.get(name)) is not None
    ]
    if not samples:
        return None
    values = [value for _, value in samples]
    return Chart(
        title=title_of(name),
        x_label="s from the event",
        y_label="",
        series=(Series(name, samples),),
        description=f"{figure(min(values))} to {figure(max(values))}",
        grounds=grounds,
        marks=(Mark(0.0, ""),),
    )


# --- documents ------------------------------------------------------------------------------------------------------


def _results(results: Sequence[replies.CalibrationResult], event: replies.EvidenceEvent) -> Table:
    def row(result: replies.CalibrationResult) -> Sequence[str | Cell]:
        when = "after" if result.data_stamp_ns > event.stamp_ns else "before"
        moved = [
            f"{axis_value(value, axis)} ± {axis_value(sigma, axis, sign=False)}"
            for axis, (value, sigma) in enumerate(zip(result.correction, result.sigma, strict=True))
        ]
        verdict = Cell(result.verdict.decision, tone=TONES.get(result.verdict.decision, "none"))
        return (second(result.data_stamp_ns), when, result.window_id, str(result.pairs), verdict, *moved)

    heads = [f"{name}, {unit}" for name, unit in zip(AXIS_NAMES, UNITS, strict=True)]
    return Table(
        "Results of windows about the event, as corrections of the nominal calibration",
        ("Data until", "The event", "Window", "Pairs", "Verdict", *heads),
        [row(result) for result in results],
        frozenset({3, *range(5, 11)}),
    )


def _refusals(results: Sequence[replies.CalibrationResult]) -> Iterable[Text]:
    """Why windows were refused, and which figures missed their limits."""
    for result in results:
        if result.verdict.decision == "accepted":
            continue
        failed = [
            f"{name} {figure(metric.value)} ({'≥' if metric.at_least else '≤'} {figure(metric.limit)} asked)"
            for name, metric in sorted(result.metrics.items())
            if metric.limit is not None and not metric.passed
        ]
        because = f" Beyond their limits: {', '.join(failed)}." if failed else ""
        why = _reasons_text(result.verdict.reasons).removesuffix(".")
        yield Text((f"{result.window_id} was refused: {why}.{because}",))


def _chain(incident: FetchedIncident) -> Block:
    if incident.chain_holds is None:
        return Text(("The hashes of these entries could not be checked here.",), quiet=True)
    if incident.chain_holds:
        return Text(("Each entry is what its hash says, and holds the hash of the one before it.",), quiet=True)
    return VerdictBanner(
        "bad", "Forged.", "The hashes of these entries do not fit: something was changed, taken out or put in."
    )


def _entries(entries: Sequence[replies.ChainedEntry]) -> Table:
    rows = [
        (
            str(item.entry.sequence),
            second(item.entry.wall_ns),
            "–" if item.entry.stamp_ns is None else second(item.entry.stamp_ns),
            item.entry.kind,
            item.entry.code,
            entry_text(item.entry),
            item.entry.sender or "",
            Cell(item.sha256[:12], code=True),
        )
        for item in entries
    ]
    heads = ("#", "Vehicle’s clock", "Sensor time", "What", "Outcome", "Why", "Who", "sha256")
    return Table("Entries about the event, oldest first", heads, rows, frozenset({0}), frozenset({5}))


def _windows(windows: Sequence[FetchedWindow]) -> Iterable[Block]:
    if not windows:
        yield Text(("None was fetched.",))
        return
    match_labels: dict[bool | None, str | Cell] = {
        True: "the one in the history",
        False: Cell("not the one in the history", tone="bad"),
        None: "–",
    }
    rows: list[Sequence[str | Cell]] = [
        (
            Cell(window.window_id, href=f"windows/{window.window_id}.mcap"),
            "–" if window.pairs is None else str(window.pairs),
            f"{window.size_bytes / 1e6:.1f}",
            window.decision or "not evaluated",
            match_labels[window.in_history],
            Cell(f"verified, {window.sha256[:16]}…", code=True),
        )
        for window in windows
    ]
    heads = ("Window", "Pairs", "MB", "Verdict", "Its result is", "sha256")
    yield Table("Windows before and after the event", heads, rows, frozenset({1, 2}))
    yield Text(
        ("They open in Foxglove, Lichtblick and ROS 2 tools; `coec replay windows/ID.mcap` reaches the recorded "
         "decision again.",),
        quiet=True,
    )  # fmt: skip


def _snippets(snippets: Sequence[str]) -> Iterable[Block]:
    if snippets:
        rows = [(Cell(one, href=f"windows/{one}.mcap"),) for one in snippets]
        yield Table("Every frame of the seconds about the event", ("Recording",), rows)


def _now(incident: FetchedIncident, health: replies.HealthReply) -> Text:
    served = "" if incident.extrinsic is None else f" Served: {incident.extrinsic.provenance}."
    why = f" {_reasons_text(health.reasons)}" if health.reasons else ""
    version = "" if incident.status is None else f" The service is coec {incident.status.version}."
    text = f"When this was fetched the pair was {health.state}, since {second(health.since_ns)}.{why}{served}{version}"
    return Text((text,))
