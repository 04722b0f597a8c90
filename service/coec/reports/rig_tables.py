"""The tables of `coec sim rig-moves` and `coec sim rig-drives`."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from coec.reports import console
from coec.reports.page.words import count
from coec.schemas.rig import RigDrivesReport, RigMovesReport


def show(report: RigMovesReport) -> None:
    """Prints which sensors were named, by fault; then how well the rig knows its pairs, in general and right after one
    of its LiDARs was knocked."""
    table = console.table(
        "rig", "fault", "drives", f"right in {report.allowed_s:g} s", "undecided", "wrong", "median", "latest",
        right=range(2, 8),
    )  # fmt: skip
    for row in report.moves:
        counts = (row.drives, row.right, row.undecided, row.wrong)
        table.add_row(row.rig, row.fault, *map(str, counts), *_late(row.delay_s))
    console.out.print(table)
    joint = console.table(
        "windows combined", "pairs", "rigs", "rms error, of single pairs", "NEES", "consistent", "1° off: found",
        "missed", right=range(1, 8),
    )  # fmt: skip
    for of in report.joint:
        joint.add_row(
            of.rig,
            str(of.pairs),
            str(of.rigs),
            _ratio(of.rms_ratio_all, of.rms_ratio),
            f"{of.nees:.2f}",
            *map(str, (of.consistent, of.biased_found, of.biased_missed)),
        )
    console.out.print(joint)
    displaced = console.table(
        "windows after a knocked LiDAR", "pairs", "rigs", "rms error, of single pairs", "without before", "NEES",
        "worst pair", "single", "consistent", "camera too, missed", right=range(1, 10),
    )  # fmt: skip
    for after in report.knocked:
        displaced.add_row(
            after.rig,
            str(after.pairs),
            str(after.rigs),
            _ratio(after.rms_ratio_all, after.rms_ratio),
            f"{after.rms_ratio_without:.2f}",
            f"{after.nees:.2f}",
            f"{after.worst_deg:.2f}°",
            f"{after.worst_of_pairs_deg:.2f}°",
            *map(str, (after.consistent, after.also_missed)),
        )
    console.out.print(displaced)


def show_drives(report: RigDrivesReport) -> None:
    """Prints which sensors were named on rendered drives, by fault; then each drive that did not end right."""
    table = console.table(
        "rendered", "drives", f"right in {report.allowed_s:g} s", "undecided", "wrong", "named: median", "latest",
        "a pair alarmed: drives", "median", "latest", right=range(1, 10),
    )  # fmt: skip
    for row in report.moves:
        counts = map(str, (row.drives, row.right, row.undecided, row.wrong))
        table.add_row(row.fault, *counts, *_late(row.delay_s), str(len(row.alarms_s)), *_late(row.alarms_s))
    console.out.print(table)
    for row in report.moves:
        for one in row.each:
            if one.wrong:
                console.show(f"  {one.name}, {row.fault}: {', '.join(one.wrong)} named {one.wrong_s:+.0f} s after it")
            elif one.named_s is None:
                console.show(f"  {one.name}, {row.fault}: {' and '.join(one.moved)} not named")
    of = f"{count(report.looks, 'look')} on {count(report.drives, 'drive')} with {report.camera}"
    windows = f"{report.windows} urgent windows: {report.accepted} accepted"
    console.show(f"{of}: {report.faint} faint, {report.blind} blind; {windows}; {count(report.failed, 'drive')} failed")


def _ratio(of_all: float, per_axis: Sequence[float]) -> str:
    return f"{of_all:.2f} ({' '.join(f'{ratio:.2f}' for ratio in per_axis)})"


def _late(seconds: tuple[float, ...]) -> tuple[str, str]:
    return (f"{median(seconds):.0f} s", f"{max(seconds):.0f} s") if seconds else ("-", "-")
