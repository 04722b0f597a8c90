"""`coec sim rig-drives`: are the sensors of a rig that moved named, and no others, on rendered drives."""

from __future__ import annotations

from coec.adapters.files import output
from coec.cli.commands.sim_rig_drives import Options
from coec.reports import console, rig_tables
from coec.schemas.base import to_json
from coec.schemas.rig import RigDriveRow
from coec.simulation.source import require_extra


def run(options: Options) -> int:
    """Draws the drives that have no result in the folder yet, and writes report.json there.

    Raises:
        SourceError: the optional extra is not installed.
        UsageError: there is no such camera.
        OutputError: a file cannot be written.
    """
    require_extra()
    from coec.evaluation import rig_drive_statistics, rig_drives

    drives = [rig_drives.KnockedDrive(number, options.camera) for number in range(options.drives)]
    rows: list[RigDriveRow] = []
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(drives), note="")
        for drive in drives:
            path = options.output / "drives" / f"{drive.name}.json"
            row = output.kept(path, RigDriveRow)
            if row is None:
                bars.update(task, note=drive.name)
                row = rig_drives.looked_at(drive)
                output.replace(path, to_json(row))
            rows.append(row)
            bars.update(task, advance=1)
    report = rig_drive_statistics.report(rows, options.camera)
    output.write(options.output / "report.json", to_json(report))
    if options.as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        rig_tables.show_drives(report)
    return 0
