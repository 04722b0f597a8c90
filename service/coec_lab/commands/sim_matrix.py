"""`coec sim matrix`: runs estimator and monitor on many simulated drives, and makes one table of the results."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import DegreesOfFreedom, Depth, Jobs, Json

if TYPE_CHECKING:
    from coec_lab.experiments.matrix_drives import MatrixDrive, Settings

Number = Annotated[
    int,
    typer.Option(
        "--round",
        help="Round of the matrix: each has the same kinds of drives, with other seeds.",
        min=1,
        max=10_000,
        metavar="N",
    ),
]
Only = Annotated[
    str | None,
    typer.Option(
        help="Only drives whose name matches; names are scene_lens_lidar_light_fault_sN: '*_night_*', '*_s1'.",
        metavar="PATTERN",
    ),
]


def matrix(
    output: Annotated[
        Path,
        typer.Option(help="Folder for report.json, normalised.png and drives/.", metavar="DIR", show_default=False),
    ],
    number: Number = 1,
    only: Only = None,
    dof: Annotated[
        DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.", show_default="both")
    ] = None,
    frames: Annotated[int, typer.Option(help="Pairs per window; a drive has two windows.", min=2, max=100)] = 10,
    depth: Depth = None,
    jobs: Jobs = None,
    as_json: Json = False,
) -> int:
    """Run estimator and monitor on simulated drives: scenes, lenses, LiDARs, light, faults.

    A drive takes about half a minute of one core, the whole matrix most of an hour. Finished drives are retained in
    DIR: run the command again to continue. A DIR holds results of one state of the code; use another after a change.
    """
    from coec.io import user_files as files
    from coec.reports import console
    from coec.schemas.message import to_json
    from coec_lab.commands.drive_pool import drive_file, finished, resumed
    from coec_lab.experiments import matrix_drives as matrix_run
    from coec_lab.experiments import matrix_statistics, plots
    from coec_lab.experiments.simulation_schemas import MatrixRow
    from coec_lab.simulation.source import require_extra

    require_extra()
    drives, settings = _selected(number, only, None if dof is None else int(dof), frames, depth)
    names = [drive.name for drive in drives]
    rows = resumed(output, names, MatrixRow, lambda row: row.settings == settings.fingerprint)
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(drives), completed=len(rows), note="")
        pending = [drive for drive in drives if drive.name not in rows]
        for row in finished(partial(matrix_run.run, settings=settings), pending, jobs):
            files.write_output(drive_file(output, row.name), to_json(row))
            rows[row.name] = row
            bars.update(task, advance=1, note=row.name)
    report = matrix_statistics.report([rows[name] for name in names])
    files.write_output(output / "report.json", to_json(report))
    files.write_output(output / "normalised.png", plots.matrix_errors(report))
    if as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        matrix_statistics.show(report)
    return 0


def _selected(
    number: int, only: str | None, dof: int | None, frames: int, depth: str | None
) -> tuple[list[MatrixDrive], Settings]:
    """The drives of a round whose name matches, and the settings with which each is run.

    Raises:
        UsageError: no drive matches, or windows are too small for a check.
    """
    from coec.config import CalibrationConfig
    from coec.errors import UsageError
    from coec_lab.experiments import matrix_drives, matrix_statistics
    from coec_lab.experiments.matrix_drives import CHECK_PAIRS, WINDOWS, Settings

    if WINDOWS * frames < CHECK_PAIRS:
        raise UsageError(f"--frames {frames}: a check needs {CHECK_PAIRS} pairs, {WINDOWS} windows have fewer")
    drives = list(matrix_drives.selected_drives(number, only))
    if not drives:
        names = ", ".join(drive.name for drive in matrix_drives.drives(number)[:3])
        raise UsageError(f"no drive of the matrix is called {only!r}; they are called {names}, ...")
    dofs = matrix_statistics.DOFS if dof is None else (dof,)
    return drives, Settings(dofs, frames, depth or CalibrationConfig().depth.model)
