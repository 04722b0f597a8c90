"""`coec sim checks`: false-alarm rate and detection delay of the monitor on rendered drives."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import Jobs, Json

if TYPE_CHECKING:
    from collections.abc import Collection

    from coec.calibration.baseline import Baseline
    from coec.errors import CalibrationError


def checks(
    output: Annotated[
        Path, typer.Option(help="Folder for report.json and drives/.", metavar="DIR", show_default=False)
    ],
    rounds: Annotated[
        int,
        typer.Option(help="Number of drives in every place with every rig, each with another seed.", min=1, max=10_000),
    ] = 4,
    first: Annotated[
        int,
        typer.Option(
            "--first-round",
            help="First round: earlier ones may have been used when rules were tuned.",
            min=1,
            max=10_000,
            metavar="N",
        ),
    ] = 1,
    hours: Annotated[
        float,
        typer.Option(help="Hours of driving to resample from these drives, whole drives at a time.", min=0, max=10_000),
    ] = 100.0,
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Measure false-alarm rate and detection delay of the monitor on rendered drives.

    A drive is 25 s of one rig in one place, checked at the true pose and at poses next to it; it takes a quarter of a
    minute of one core, a round 40 of them. For errors that no drive has shown, a tail is fitted to the errors of the
    places. Finished drives are retained in DIR: run the command again, with more rounds, to continue. A DIR holds
    results of one state of the code.
    """
    from coec.io import user_files as files
    from coec.reports import console
    from coec.schemas.message import to_json
    from coec_lab.commands.drive_pool import drive_file, finished, resumed
    from coec_lab.experiments import check_drives, check_statistics
    from coec_lab.experiments import check_drives as check_run
    from coec_lab.experiments import check_statistics as check_tables
    from coec_lab.experiments.simulation_schemas import CheckedDrive
    from coec_lab.simulation.source import require_extra

    require_extra()
    series = list(check_drives.drives(rounds, first))
    names = [drive.name for outing in series for drive in outing]
    rows = resumed(output, names, CheckedDrive)
    unfinished = ([drive for drive in outing if drive.name not in rows] for outing in series)
    pending = [outing for outing in unfinished if outing]
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(names), completed=len(rows), note="commissioning")
        baselines = _baselines({drive.rig for outing in pending for drive in outing}, jobs)
        for outing in finished(partial(check_run.run, baselines=baselines), pending, jobs):
            for row in outing:
                files.write_output(drive_file(output, row.name), to_json(row))
                rows[row.name] = row
                bars.update(task, advance=1, note=row.name)
    report = check_statistics.report([rows[name] for name in names], hours)
    files.write_output(output / "report.json", to_json(report))
    if as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        check_tables.show(report)
    return 0


def _baselines(rigs: Collection[str], jobs: int | None) -> dict[str, Baseline]:
    """Baselines of those rigs that can be commissioned."""
    from coec.errors import CalibrationError
    from coec.reports import console
    from coec_lab.commands.drive_pool import finished

    baselines: dict[str, Baseline] = {}
    for rig, learned in finished(_commissioned, sorted(rigs), jobs):
        if isinstance(learned, CalibrationError):
            console.show(f"{rig} cannot be commissioned: {learned}", "red")
        else:
            baselines[rig] = learned
    return baselines


def _commissioned(rig: str) -> tuple[str, Baseline | CalibrationError]:
    from coec.errors import CalibrationError
    from coec_lab.experiments import check_drives as check_run

    try:
        return rig, check_run.commissioned(rig)
    except CalibrationError as error:
        return rig, error
