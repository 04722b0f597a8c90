"""The tables of `coec sim matrix`."""

from __future__ import annotations

from coec.reports import console
from coec.reports.page.words import count
from coec.schemas.matrix import MatrixReport, SolvedWindow, SolveStatistics, WatchStatistics


def show(report: MatrixReport) -> None:
    """Prints the drives one by one, then the figures over all of them."""
    for solves in report.solves:
        _show_drives(report, solves)
    for solves in report.solves:
        _show_solves(solves)
    _show_watched(report.watched)
    for name, failure in report.failed.items():
        console.show(f"no result: {name}: {failure}", "red")


def _show_drives(report: MatrixReport, solves: SolveStatistics) -> None:
    console.show(f"{solves.dof} degrees of freedom", "bold")
    table = console.table("drive", "start", "error deg", "± σ", "error m", "± σ", "", right=range(1, 6))
    for row in report.rows:
        for window in row.windows.get("3" if solves.dof == 3 else "6", ()):
            table.add_row(
                row.name,
                console.figure(window.start_deg, 1),
                console.figure(window.rotation_deg, 2),
                console.figure(_largest(window, range(3)), 2),
                console.figure(window.translation_m if solves.dof == 6 else None, 3),
                console.figure(_largest(window, range(3, 6)), 3),
                _decision(window),
            )
    console.out.print(table)


def _decision(window: SolvedWindow) -> str:
    if window.failure is not None:
        return f"no estimate: {window.failure}"
    hit = "hit" if window.hit else "miss"
    return f"accepted {hit}" if window.accepted else f"refused {hit}: {', '.join(window.reasons)}"


def _largest(window: SolvedWindow, axes: range) -> float | None:
    known = [sigma for axis in axes if (sigma := window.sigma[axis]) is not None]
    return max(known) if known else None


def _show_solves(solves: SolveStatistics) -> None:
    console.show(
        f"{solves.dof} dof: {count(solves.windows, 'window')}, {count(solves.hits, 'hit')}, {solves.accepted} accepted "
        f"({solves.accepted_hits} of them hits), {solves.accepted_wrong} accepted and wrong",
        "bold",
    )
    for wrong in solves.wrong:
        console.show(f"  {wrong}", "red")
    axes = console.table(
        "axis", "n", "bias", "rms", "mean σ", "σ/rms", "rms e/σ", "≤ 1σ", "≤ 2σ", "≤ 3σ", right=range(1, 10)
    )
    for axis in solves.axes:
        axes.add_row(
            axis.axis,
            str(axis.windows),
            console.figure(axis.bias, sign=True),
            *(console.figure(value) for value in (axis.rms, axis.mean_sigma)),
            *(console.figure(value, 2) for value in (axis.sigma_over_rms, axis.rms_normalised)),
            *(_percent(value) for value in (axis.within_1, axis.within_2, axis.within_3)),
        )
    console.out.print(axes)
    groups = console.table("", "", "windows", "hits", "accepted", "wrong", "median deg", right=range(2, 7))
    for group in solves.groups:
        counts = (group.windows, group.hits, group.accepted, group.accepted_wrong)
        groups.add_row(group.of, group.value, *map(str, counts), console.figure(group.median_deg, 2))
    console.out.print(groups)
    console.show(f"refused for: {', '.join(f'{code} {count}' for code, count in solves.reasons.items()) or 'nothing'}")


def _show_watched(watched: tuple[WatchStatistics, ...]) -> None:
    table = console.table(
        "served pose", "drives", "checks", "flagged", "blind", "alarmed", "alarms/h", "delay", right=range(1, 8)
    )
    for watch in watched:
        table.add_row(
            watch.moved,
            *map(str, (watch.drives, watch.checks)),
            _percent(watch.flagged),
            *map(str, (watch.blind, watch.alarmed)),
            console.figure(watch.alarms_per_hour, 2),
            f"{console.figure(watch.median_delay_checks, 1)} checks",
        )
    console.out.print(table)
    for watch in watched:
        what = "false alarm" if watch.moved == "right" else f"not seen, {watch.moved}"
        if watch.names:
            console.show(f"{what}: {', '.join(watch.names)}")


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f} %"
