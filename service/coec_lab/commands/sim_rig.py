"""`coec sim rig-drives` and `coec sim rig-moves`: whether a rig identifies the sensors that moved, and no others."""

from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Jobs, Json


def rig_drives(
    output: Annotated[
        Path, typer.Option(help="Folder for report.json and drives/.", metavar="DIR", show_default=False)
    ],
    drives: Annotated[int, typer.Option(help="Number of drives, each with every fault.", min=1, max=10_000)] = 30,
    camera: Annotated[
        str, typer.Option(help="Model of every camera of the rig: fisheyeW.", metavar="NAME")
    ] = "fisheye700",
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Measure on rendered drives how well a rig identifies the sensors that moved, and no others.

    A drive is a minute and a half of a street with four fisheyes and a LiDAR, rendered as the rig was built and with
    two cameras and the LiDAR turned by 1°; it takes some minutes of one core. Pairs that suspect a move record a
    window, as on the vehicle. Only the image rows that the LiDAR sees are rendered. Finished drives are retained in
    DIR: run the command again, with more drives, to continue. A DIR holds results of one state of the code.
    """
    from coec.io import user_files as files
    from coec.reports import console
    from coec.schemas.message import to_json
    from coec_lab.commands.drive_pool import drive_file, finished, resumed
    from coec_lab.experiments import rig_drive_statistics, rig_drives
    from coec_lab.experiments import rig_moves as rig_tables
    from coec_lab.experiments.rig_drives import DisplacedRigDrive
    from coec_lab.experiments.simulation_schemas import RigDriveRow
    from coec_lab.simulation.source import require_extra

    require_extra()
    planned = [DisplacedRigDrive(number, camera) for number in range(drives)]
    names = [drive.name for drive in planned]
    rows = resumed(output, names, RigDriveRow)
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(names), completed=len(rows), note="")
        pending = [drive for drive in planned if drive.name not in rows]
        for row in finished(rig_drives.driven, pending, jobs):
            files.replace_output(drive_file(output, row.name), to_json(row))
            rows[row.name] = row
            bars.update(task, advance=1, note=row.name)
    report = rig_drive_statistics.report([rows[name] for name in names], camera)
    files.write_output(output / "report.json", to_json(report))
    if as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        rig_tables.show_drives(report)
    return 0


def rig_moves(
    drives: Annotated[int, typer.Option(help="Number of drives for each fault.", min=1, max=10_000)] = 30,
    rigs: Annotated[int, typer.Option(help="Number of rigs whose windows are combined.", min=1, max=10_000)] = 50,
    as_json: Json = False,
) -> int:
    """Measure on simulated measurements of all pairs how well a rig identifies the sensors that moved, and no others.

    Nothing is rendered: checks and windows are sampled at random, with all the errors of real ones. A drive takes one
    to three seconds of a core.
    """
    from coec.reports import console
    from coec_lab.experiments import rig_moves
    from coec_lab.experiments import rig_moves as rig_tables

    with console.progress() as bars:
        task = bars.add_task("drives", total=len(rig_moves.FAULTS) * drives, note="")
        report = rig_moves.report(drives, rigs, lambda note: bars.update(task, advance=1, note=note))
    if as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        rig_tables.show(report)
    return 0
