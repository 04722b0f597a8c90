"""`coec sim rig-moves`: whether a rig names the sensors that moved, and no others."""

from __future__ import annotations

from coec.evaluation import rig_moves
from coec.reports import console, rig_tables


def run(drives: int, rigs: int, *, as_json: bool) -> int:
    """Draws `drives` drives of each fault and `rigs` rigs, and prints the report."""
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(rig_moves.FAULTS) * drives, note="")
        report = rig_moves.report(drives, rigs, lambda note: bars.update(task, advance=1, note=note))
    if as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        rig_tables.show(report)
    return 0
