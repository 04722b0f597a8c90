"""`coec sim checks`: how often the monitor accuses a right mount on rendered drives, and how soon it notices a wrong
one."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from coec.adapters.files import output
from coec.calibration.commissioning.baseline import Baseline
from coec.cli.commands.sim_checks import Options
from coec.errors import CalibrationError
from coec.evaluation import check_drives, check_run, check_statistics
from coec.reports import check_tables, console
from coec.schemas.base import to_json
from coec.schemas.checks import CheckedDrive
from coec.simulation.source import require_extra
from coec_lab.commands.drives_at_once import finished


def run(options: Options) -> int:
    """Draws and checks the drives that have no result in the folder yet, and writes report.json there.

    Raises:
        SourceError: the optional extra is not installed.
        OutputError: a file cannot be written.
        DrivesError: a process died.
    """
    require_extra()
    outings = list(check_drives.drives(options.rounds, options.first))
    drives = [drive for outing in outings for drive in outing]
    rows = {
        drive.name: row
        for drive in drives
        if (row := output.kept(_path(options.output, drive.name), CheckedDrive)) is not None
    }
    left = ([drive for drive in outing if drive.name not in rows] for outing in outings)
    waiting = [outing for outing in left if outing]
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(drives), completed=len(rows), note="commissioning")
        rigs = sorted({drive.rig for outing in waiting for drive in outing})
        baselines: dict[str, Baseline] = {}
        for rig, learned in finished(_commissioned, rigs, options.jobs):
            if isinstance(learned, CalibrationError):
                console.show(f"{rig} cannot be commissioned: {learned}", "red")
            else:
                baselines[rig] = learned
        for outing in finished(partial(check_run.run, baselines=baselines), waiting, options.jobs):
            for row in outing:
                output.write(_path(options.output, row.name), to_json(row))
                rows[row.name] = row
                bars.update(task, advance=1, note=row.name)
    report = check_statistics.report([rows[drive.name] for drive in drives], options.hours)
    output.write(options.output / "report.json", to_json(report))
    if options.as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        check_tables.show(report)
    return 0


def _commissioned(rig: str) -> tuple[str, Baseline | CalibrationError]:
    try:
        return rig, check_run.commissioned(rig)
    except CalibrationError as error:
        return rig, error


def _path(folder: Path, name: str) -> Path:
    return folder / "drives" / f"{name}.json"
