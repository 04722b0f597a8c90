"""How often a right mount is accused, and how soon a wrong one: as a document, on the console, and as a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coec.evaluation.alarms import AlarmExperiments
from coec.reports import console
from coec.reports.evaluation_documents import number
from coec.schemas import evaluation as wire


def document_of(alarms: AlarmExperiments) -> wire.AlarmsReport:
    """What `coec alarms --json` prints."""
    config = alarms.config
    return wire.AlarmsReport(
        period_s=config.period_s,
        hours_between_false_alarms=config.hours_between_false_alarms,
        hours_between_false_suspicions=config.hours_between_false_suspicions,
        false=tuple(
            wire.FalseAlarmsRow(stated_h=row.stated_h, driven_h=row.driven_h, alarms=row.alarms) for row in alarms.false
        ),
        delays=tuple(
            wire.DelayRow(
                step_deg=row.step_deg,
                steps=len(row.confirmed_s),
                suspect_s=_spread(row.suspect_s),
                confirmed_s=_spread(row.confirmed_s),
            )
            for row in alarms.delays
        ),
        creep_deg_per_h=alarms.creep.deg_per_h,
        creep_suspect_h=_spread(alarms.creep.suspect_h),
        creep_confirmed_h=_spread(alarms.creep.confirmed_h),
        from_start=tuple(
            wire.FromStartRow(
                off_deg=row.off_deg,
                rigs=len(row.requested_s),
                wanted=float(np.mean(np.isfinite(row.requested_s))),
                wanted_s=_spread(row.requested_s),
            )
            for row in alarms.from_start
        ),
    )


def show(report: wire.AlarmsReport) -> None:
    """Prints the tables."""
    false = console.table("stated between false alarms", "driven", "false alarms", right=range(3))
    for row in report.false:
        false.add_row(f"{row.stated_h:g} h", f"{row.driven_h:g} h", str(row.alarms))
    console.out.print(false)
    columns = ("step", "steps", "suspect, median", "p95", "confirmed, median", "p95", "unit")
    delays = console.table(*columns, right=range(6))
    for step in report.delays:
        figures = (step.suspect_s.median, step.suspect_s.p95, step.confirmed_s.median, step.confirmed_s.p95)
        delays.add_row(f"{step.step_deg:g}°", str(step.steps), *(console.figure(value, 0) for value in figures), "s")
    console.out.print(delays)
    started = console.table("wrong from the first check", "rigs", "window wanted", "median", "unit", right=range(4))
    for rigs in report.from_start:
        median = console.figure(rigs.wanted_s.median, 0)
        started.add_row(f"{rigs.off_deg:g}°", str(rigs.rigs), f"{100 * rigs.wanted:.0f} %", median, "s")
    console.out.print(started)
    suspect, confirmed = report.creep_suspect_h, report.creep_confirmed_h
    console.show(
        f"a creep of {report.creep_deg_per_h:g}°/h is suspected after {console.figure(suspect.median, 1)} h and "
        f"confirmed after {console.figure(confirmed.median, 1)} h (median); - is not in time"
    )


def delay_curve(report: wire.AlarmsReport) -> bytes:
    """PNG: the delay against the size of the step; steps that are not noticed in time have no point."""
    # matplotlib takes a second to import.
    from matplotlib.figure import Figure

    from coec.reports.plots import png

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    steps = [row.step_deg for row in report.delays]
    for name, spreads in (
        ("suspect", [row.suspect_s for row in report.delays]),
        ("confirmed", [row.confirmed_s for row in report.delays]),
    ):
        medians = [np.nan if spread.median is None else spread.median for spread in spreads]
        ninety_fifths = [np.nan if spread.p95 is None else spread.p95 for spread in spreads]
        (line,) = axes.plot(steps, medians, marker="o", label=f"{name}, median")
        axes.plot(steps, ninety_fifths, color=line.get_color(), linestyle=":", label=f"{name}, 95th percentile")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(steps, [f"{step:g}" for step in steps])
    axes.set_xlabel("step of the mount, degrees")
    axes.set_ylabel("delay, s")
    axes.set_title(f"a check every {report.period_s:g} s, a false alarm in {report.hours_between_false_alarms:g} h")
    axes.grid(alpha=0.3)
    axes.legend()
    return png(figure)


def _spread(values: Sequence[float]) -> wire.Spread:
    """Spread of some delays; a figure is None if the delay there is infinite, that is, not noticed in time."""
    median, p95 = (float(np.percentile(values, share, method="higher")) for share in (50, 95))
    return wire.Spread(median=number(median), p95=number(p95), max=number(max(values)))
