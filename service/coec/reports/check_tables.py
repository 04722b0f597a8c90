"""The tables of `coec sim checks`."""

from __future__ import annotations

from statistics import median

from coec.reports import console
from coec.schemas.checks import ChecksReport, RigStatistics


def show(report: ChecksReport) -> None:
    """Prints shares of checks and drives by move, then false alarms in hours of driving."""
    for rigs in report.rigs:
        _show(rigs)
    for name, failure in report.failed.items():
        console.show(f"no result: {name}: {failure}", "red")


def _show(rigs: RigStatistics) -> None:
    console.show("commissioned rigs" if rigs.commissioned else "rigs of which nothing is known", "bold")
    table = console.table(
        "served pose", "checks", "blind", "faint", "undecided", "clear", "flagged", "of clear", "95 %", "drives",
        "suspected", "confirmed", "delay", right=range(1, 13),
    )  # fmt: skip
    for row in rigs.moved:
        share = f"{100.0 * row.flagged / row.clear:.1f} %" if row.clear else "-"
        between = (
            "-"
            if row.flagged_low is None or row.flagged_high is None
            else f"{100.0 * row.flagged_low:.1f} to {100.0 * row.flagged_high:.1f} %"
        )
        delay = f"{median(row.delay_checks):g} checks" if row.delay_checks else "-"
        counts = (row.checks, row.blind, row.weak, row.undecided, row.clear, row.flagged)
        drives = (row.drives, row.suspected, row.confirmed)
        table.add_row(row.moved, *map(str, counts), share, between, *map(str, drives), delay)
    console.out.print(table)
    places = console.table("right mount", "checks", "blind", "faint", "undecided", "flagged", right=range(1, 6))
    for place in rigs.places:
        places.add_row(place.place, *map(str, (place.checks, place.blind, place.weak, place.undecided, place.flagged)))
    console.out.print(places)
    hours = console.table("right mount", "hours", "suspicions", "alarms", "in 100 h at most (95 %)", right=range(1, 5))
    for driven in rigs.hours:
        hours.add_row(
            driven.how,
            console.figure(driven.hours, 1),
            *map(str, (driven.suspicions, driven.alarms)),
            console.figure(driven.alarms_per_100_h_at_most, 1),
        )
    console.out.print(hours)
    if rigs.tails:
        tails = console.table(
            "places of", "places", "farthest, σ", "accused at, σ", "in 100 h", "at most (95 %)", right=range(1, 6)
        )
        for tail in rigs.tails:
            tails.add_row(
                f"{tail.stay_checks} checks",
                str(tail.places),
                console.figure(tail.farthest, 1),
                "-" if tail.accused_at is None else console.figure(tail.accused_at, 0),
                console.figure(tail.alarms_per_100_h, 3),
                console.figure(tail.alarms_per_100_h_at_most, 3),
            )
        console.out.print(tails)
    for driven in rigs.hours:
        if driven.alarmed:
            console.show(f"false alarms, {driven.how}: {', '.join(driven.alarmed)}")
