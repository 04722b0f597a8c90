"""What `coec sim rig-moves` says in tables."""

from __future__ import annotations

from statistics import median

from coec.reports import console
from coec.schemas.rig import RigMovesReport


def show(report: RigMovesReport) -> None:
    """Who moved, by fault; then what the rig knows of its pairs."""
    table = console.table(
        "rig", "fault", "drives", f"right in {report.allowed_s:g} s", "undecided", "wrong", "median", "latest",
        right=range(2, 8),
    )  # fmt: skip
    for row in report.moves:
        counts = (row.drives, row.right, row.undecided, row.wrong)
        late = (f"{median(row.delay_s):.0f} s", f"{max(row.delay_s):.0f} s") if row.delay_s else ("-", "-")
        table.add_row(row.rig, row.fault, *map(str, counts), *late)
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
            f"{of.rms_ratio_all:.2f} ({' '.join(f'{ratio:.2f}' for ratio in of.rms_ratio)})",
            f"{of.nees:.2f}",
            *map(str, (of.consistent, of.biased_found, of.biased_missed)),
        )
    console.out.print(joint)
