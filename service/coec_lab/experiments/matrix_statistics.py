"""Statistics of the matrix of drives, from rows to figures, and their tables.

The claims of an estimate hold if its errors, each divided by the claimed sigma, follow a normal distribution of
variance one. Errors and sigmas are those of the accepted windows, because only these would be served.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from math import fsum, sqrt
from statistics import median
from typing import Literal

from coec.reports import console
from coec.reports.formatting import count
from coec_lab.experiments import simulation_schemas

HIT_DEG, HIT_M = 0.5, 0.10
"""A hit is at most this far from the truth."""
WRONG_DEG, WRONG_M, WRONG_SIGMAS = 0.3, 0.10, 4.0
"""An accepted window is wrong on an axis where it is off by more than this and by more than `WRONG_SIGMAS` sigmas."""
AXES: tuple[Literal["rx", "ry", "rz", "tx", "ty", "tz"], ...] = ("rx", "ry", "rz", "tx", "ty", "tz")
DOFS: tuple[Literal[3, 6], ...] = (3, 6)
PROPERTIES: dict[str, Callable[[simulation_schemas.MatrixRow], str]] = {
    "scene": lambda row: row.scene,
    "lens": lambda row: row.lens,
    "lidar": lambda row: row.lidar,
    "light": lambda row: row.light,
    "fault": lambda row: row.fault,
}

Solves = list[tuple[simulation_schemas.MatrixRow, int, simulation_schemas.SolvedWindow]]
"""Windows, each with its drive and its place there."""


def is_hit(rotation_deg: float, translation_m: float, dof: int) -> bool:
    """Whether an error counts as a hit; the translation counts only where it was searched."""
    return rotation_deg <= HIT_DEG and (dof == 3 or translation_m <= HIT_M)


def report(rows: Sequence[simulation_schemas.MatrixRow]) -> simulation_schemas.MatrixReport:
    """All figures of the rows, in the order of `rows`."""
    solves = [of_solves(dof, _solves(rows, dof)) for dof in DOFS if any(str(dof) in row.windows for row in rows)]
    moves = dict.fromkeys(watch.moved for row in rows for watch in row.watched)
    watched = [
        of_watches(moved, [(row.name, watch) for row in rows for watch in row.watched if watch.moved == moved])
        for moved in moves
    ]
    return simulation_schemas.MatrixReport(
        drives=len(rows),
        failed={row.name: row.failure for row in rows if row.failure is not None},
        solves=tuple(solves),
        watched=tuple(watched),
        rows=tuple(rows),
    )


def of_solves(dof: Literal[3, 6], solves: Solves) -> simulation_schemas.SolveStatistics:
    """Figures of the windows solved with one number of degrees of freedom."""
    accepted = [window for _, _, window in solves if window.accepted]
    wrong = [text for row, place, window in solves for text in wrong_axes(f"{row.name}#{place + 1}", window)]
    return simulation_schemas.SolveStatistics(
        dof=dof,
        windows=len(solves),
        hits=sum(window.hit for _, _, window in solves),
        accepted=len(accepted),
        accepted_hits=sum(window.hit for window in accepted),
        accepted_wrong=_wrong(solves),
        wrong=tuple(wrong),
        axes=tuple(of_axis(axis, accepted) for axis in range(dof)),
        groups=tuple(_groups(solves)),
        reasons=dict(sorted(Counter(code for _, _, window in solves for code in window.reasons).items())),
    )


def of_axis(axis: int, windows: Iterable[simulation_schemas.SolvedWindow]) -> simulation_schemas.AxisStatistics:
    """Errors on one axis against the claimed sigmas."""
    both = [(window.error[axis], window.sigma[axis]) for window in windows]
    known = [(error, sigma) for error, sigma in both if error is not None and sigma is not None and sigma > 0.0]
    errors, sigmas = [error for error, _ in known], [sigma for _, sigma in known]
    normalised = normalised_errors(axis, windows)
    rms, mean_sigma = _rms(errors), _mean(sigmas)
    return simulation_schemas.AxisStatistics(
        axis=AXES[axis],
        windows=len(known),
        bias=_mean(errors),
        rms=rms,
        mean_sigma=mean_sigma,
        sigma_over_rms=mean_sigma / rms if rms and mean_sigma is not None else None,
        rms_normalised=_rms(normalised),
        within_1=_within(normalised, 1.0),
        within_2=_within(normalised, 2.0),
        within_3=_within(normalised, 3.0),
    )


def normalised_errors(axis: int, windows: Iterable[simulation_schemas.SolvedWindow]) -> list[float]:
    """Errors on an axis divided by the claimed sigmas, of the windows that claim one."""
    both = [(window.error[axis], window.sigma[axis]) for window in windows]
    return [error / sigma for error, sigma in both if error is not None and sigma is not None and sigma > 0.0]


def wrong_axes(name: str, window: simulation_schemas.SolvedWindow) -> list[str]:
    """The axes on which an accepted window is wrong, each with its figures; none for a refused window."""
    if not window.accepted:
        return []
    wrong = []
    for axis, (error, sigma) in enumerate(zip(window.error, window.sigma, strict=True)):
        unit, limit = ("deg", WRONG_DEG) if axis < 3 else ("m", WRONG_M)
        if error is not None and abs(error) > max(limit, WRONG_SIGMAS * (sigma or 0.0)):
            wrong.append(f"{name} {AXES[axis]} {error:+.3f} ± {sigma or 0.0:.3f} {unit}")
    return wrong


def of_watches(
    moved: str, watches: Sequence[tuple[str, simulation_schemas.Watched]]
) -> simulation_schemas.WatchStatistics:
    """Figures of all checks of one served pose; `watches` are given with the names of their drives."""
    usable = sum(watch.checks - watch.blind for _, watch in watches)
    hours = fsum(watch.seconds for _, watch in watches) / 3600.0
    alarms = sum(watch.alarms for _, watch in watches)
    delays = [watch.delay_checks for _, watch in watches if watch.delay_checks is not None]
    right = moved == "right"
    return simulation_schemas.WatchStatistics(
        moved=moved,
        drives=len(watches),
        checks=sum(watch.checks for _, watch in watches),
        flagged=sum(watch.flagged for _, watch in watches) / usable if usable else None,
        blind=sum(watch.blind for _, watch in watches),
        alarms=alarms,
        alarmed=len(delays),
        hours=hours,
        alarms_per_hour=alarms / hours if hours > 0.0 else None,
        median_delay_checks=float(median(delays)) if delays else None,
        names=tuple(name for name, watch in watches if bool(watch.alarms) is right),
    )


def _solves(rows: Sequence[simulation_schemas.MatrixRow], dof: Literal[3, 6]) -> Solves:
    key: Literal["3", "6"] = "3" if dof == 3 else "6"
    return [(row, place, window) for row in rows for place, window in enumerate(row.windows.get(key, ()))]


def _groups(solves: Solves) -> Iterable[simulation_schemas.GroupStatistics]:
    for of, value_of in PROPERTIES.items():
        for value in dict.fromkeys(value_of(row) for row, _, _ in solves):
            some = [solve for solve in solves if value_of(solve[0]) == value]
            rotations_deg = [window.rotation_deg for _, _, window in some if window.rotation_deg is not None]
            yield simulation_schemas.GroupStatistics(
                of=of,
                value=value,
                windows=len(some),
                hits=sum(window.hit for _, _, window in some),
                accepted=sum(window.accepted for _, _, window in some),
                accepted_wrong=_wrong(some),
                median_deg=median(rotations_deg) if rotations_deg else None,
            )


def _wrong(solves: Solves) -> int:
    return sum(bool(wrong_axes(row.name, window)) for row, _, window in solves)


def _mean(values: Sequence[float]) -> float | None:
    return fsum(values) / len(values) if values else None


def _rms(values: Sequence[float]) -> float | None:
    return sqrt(fsum(value * value for value in values) / len(values)) if values else None


def _within(normalised: Sequence[float], sigmas: float) -> float | None:
    return sum(abs(value) <= sigmas for value in normalised) / len(normalised) if normalised else None


def show(report: simulation_schemas.MatrixReport) -> None:
    """Prints the drives one by one, then the figures over all of them."""
    for solves in report.solves:
        _show_drives(report, solves)
    for solves in report.solves:
        _show_solves(solves)
    _show_watched(report.watched)
    for name, failure in report.failed.items():
        console.show(f"no result: {name}: {failure}", "red")


def _show_drives(report: simulation_schemas.MatrixReport, solves: simulation_schemas.SolveStatistics) -> None:
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


def _decision(window: simulation_schemas.SolvedWindow) -> str:
    if window.failure is not None:
        return f"no estimate: {window.failure}"
    hit = "hit" if window.hit else "miss"
    return f"accepted {hit}" if window.accepted else f"refused {hit}: {', '.join(window.reasons)}"


def _largest(window: simulation_schemas.SolvedWindow, axes: range) -> float | None:
    known = [sigma for axis in axes if (sigma := window.sigma[axis]) is not None]
    return max(known) if known else None


def _show_solves(solves: simulation_schemas.SolveStatistics) -> None:
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


def _show_watched(watched: tuple[simulation_schemas.WatchStatistics, ...]) -> None:
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
