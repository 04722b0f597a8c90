"""The page of the demonstration: what was knocked, what the service said about it, and which files there are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

from coec.reports import console
from coec.reports.page import (
    Block,
    Cell,
    Chart,
    Charts,
    Compare,
    Facts,
    Ground,
    Limit,
    Mark,
    Page,
    Section,
    Series,
    Table,
    Text,
    Verdict,
)
from coec.reports.page.words import count
from coec.reports.page_parts import TONES, copies_of, figures_block
from coec.reports.provenance import Made
from coec.schemas import replies
from coec_lab.demo import story
from coec_lab.demo.outcome import Ending
from coec_lab.demo.watch import Moment

ABOUT = (
    "The vehicle, its street and its sensors are simulated, so the truth is known; the service is the one that runs on "
    "a vehicle, in a process of its own, and has seen the frames alone. Its depth network is the one that comes with "
    "it, trained on other streets of the same simulation."
)

Seen = tuple[float, float, str]
"""Second of the drive, error in degrees, state of health."""


def demo_page(
    title: str,
    series: Sequence[Seen],
    happened: Sequence[tuple[Moment, str]],
    summary: Sequence[tuple[str, str]],
    outcome: Ending,
    result: replies.CalibrationResult | None,
    compared: Compare | None,
    window: Path | None,
    made: Made,
) -> Page:
    """The page.

    Args:
        series: everything that was seen, in order of time.
        happened: the moments at which something changed, each with a remark that may be empty.
        summary: names and values.
        result: of the window that repaired the mount; None: there is none.
        compared: points on the image before and after the repair; None: they were not drawn.
        window: the recorded window that repaired the mount; None: there is none.
    """
    sections = [Section("Error and health over the drive", (Charts((_curve(series, outcome),)),))]
    if compared is not None:
        sections.append(Section("Points on the image", (compared,)))
    sections.append(Section("What the service said", (_said(happened),)))
    if result is not None:
        sections.append(Section("The window that repaired it", _repair(result, window)))
    verdict = (
        Verdict("good", "Repaired.", "The knock was noticed and repaired.")
        if outcome.passed
        else Verdict("bad", "Not repaired.", " ".join(outcome.objections()))
    )
    opening = (verdict, Text((ABOUT,)), Facts(tuple(summary)))
    return Page("coec demo", title, opening, (*sections, made.section()))


def _curve(series: Sequence[Seen], outcome: Ending) -> Chart:
    ends = [second for second, *_ in series[1:]] + [series[-1][0]]
    told = [(second, end, state) for (second, _, state), end in zip(series, ends, strict=True)]
    grounds = []
    for state, of_state in groupby(told, key=lambda each: each[2]):
        spans = list(of_state)
        grounds.append(Ground(spans[0][0], spans[-1][1], TONES.get(state, "none"), state))
    marks = ((outcome.knock_s, "knock"), (outcome.alarm_s, "alarm"), (outcome.repaired_s, "repair"))
    worst_deg = max(error_deg for _, error_deg, _ in series)
    return Chart(
        title="Error of the extrinsic that is served, which the service cannot know",
        x_label="drive, s",
        y_label="rotation error, °",
        series=(Series("error against the truth", list(_turns(series)), "steps"),),
        told=f"the error is {worst_deg:.2f}° at most and {series[-1][1]:.2f}° at the end",
        grounds=tuple(grounds),
        marks=tuple(Mark(second, f"{name}, {second:.0f} s") for second, name in marks if second is not None),
        limits=(Limit(story.MAX_ERROR_DEG, f"{story.MAX_ERROR_DEG:g}°: a good error"),),
        from_zero=True,
    )


def _turns(series: Sequence[Seen]) -> Iterator[tuple[float, float]]:
    """The points at which the error changes, and the last point."""
    before: float | None = None
    for second, error_deg, _ in series:
        if error_deg != before:
            yield second, error_deg
        before = error_deg
    yield series[-1][0], series[-1][1]


def _said(happened: Sequence[tuple[Moment, str]]) -> Table:
    rows = [
        (
            f"{moment.t_s:.0f} s",
            f"{moment.drive_s:.1f} s",
            Cell(moment.health, tone=TONES.get(moment.health, "none")),
            f"{moment.provenance}, {console.attempt(moment.status)}",
            f"{moment.error_deg:.3f}°",
            remark,
        )
        for moment, remark in happened
    ]
    heads = ("Elapsed", "Drive", "Health", "Extrinsic", "Error", "What happened")
    return Table("Every moment at which it said something new", heads, rows, frozenset({0, 1, 4}))


def _repair(result: replies.CalibrationResult, window: Path | None) -> tuple[Block, ...]:
    told = (
        f"{count(result.pairs, 'pair')}, verdict {result.verdict.decision}, configuration {result.config_hash}. The "
        "figures are of its self-diagnosis, without the truth; a result is accepted if it keeps all limits."
    )
    left = () if window is None else (_window(window),)
    copies = copies_of(result.camera_from_lidar, result.camera_frame, result.lidar_frame)
    return Text((told,)), figures_block("Figures of self-diagnosis", result.metrics), copies, *left


def _window(path: Path) -> Text:
    return Text(
        (
            f"`{path.name}` beside this page is a ROS 2 MCAP file for Foxglove, Lichtblick or Rerun; "
            f"`coec replay {path.name}` reaches the decision again from it alone.",
        )
    )
