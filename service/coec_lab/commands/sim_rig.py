"""`coec sim rig-drives`: whether a rig names the sensors that moved, and no others, on rendered drives."""

from __future__ import annotations

from coec.adapters.files import output
from coec.cli.commands.sim_rig_drives import Options
from coec.reports import console, rig_tables
from coec.schemas.base import to_json
from coec.schemas.rig import RigDriveRow
from coec.simulation.source import require_extra
from coec_lab.commands.drives_at_once import finished


def run(options: Options) -> int:
    """Draws the drives that have no result in the folder yet, and writes report.json there.

    Raises:
        SourceError: the optional extra is not installed.
        UsageError: there is no such camera.
        OutputError: a file cannot be written.
        DrivesError: a process died.
    """
    require_extra()
    from coec.evaluation import rig_drive_statistics, rig_drives
    from coec.evaluation.knocked_drive import KnockedDrive

    drives = [KnockedDrive(number, options.camera) for number in range(options.drives)]
    paths = {drive.name: options.output / "drives" / f"{drive.name}.json" for drive in drives}
    rows = {name: row for name, path in paths.items() if (row := output.kept(path, RigDriveRow)) is not None}
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(drives), completed=len(rows), note="")
        waiting = [drive for drive in drives if drive.name not in rows]
        for row in finished(rig_drives.driven, waiting, options.jobs):
            output.replace(paths[row.name], to_json(row))
            rows[row.name] = row
            bars.update(task, advance=1, note=row.name)
    report = rig_drive_statistics.report([rows[drive.name] for drive in drives], options.camera)
    output.write(options.output / "report.json", to_json(report))
    if options.as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        rig_tables.show_drives(report)
    return 0
