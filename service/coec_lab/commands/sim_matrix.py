"""`coec sim matrix`: runs estimator and monitor on many simulated drives, and makes one table of the results."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from coec.adapters.files import output
from coec.cli.commands.sim_matrix import Options
from coec.config import CalibrationConfig
from coec.errors import UsageError
from coec.evaluation import matrix, matrix_drives, matrix_run
from coec.evaluation.matrix_drives import MatrixDrive
from coec.evaluation.matrix_run import CHECK_PAIRS, WINDOWS, Settings
from coec.reports import console, matrix_plots, matrix_tables
from coec.schemas.base import to_json
from coec.schemas.matrix import MatrixRow
from coec.simulation.source import require_extra
from coec_lab.commands.drives_at_once import finished


def run(options: Options) -> int:
    """Runs the drives that have no result in the folder yet, and writes report.json and a picture there.

    Raises:
        UsageError: no drive matches, or windows are too small for a check.
        SourceError: the optional extra is not installed.
        OutputError: a file cannot be written.
        DrivesError: a process died.
    """
    require_extra()
    if WINDOWS * options.frames < CHECK_PAIRS:
        raise UsageError(f"--frames {options.frames}: a check needs {CHECK_PAIRS} pairs, {WINDOWS} windows have fewer")
    drives = matrix_drives.chosen(options.number, options.only)
    if not drives:
        names = ", ".join(drive.name for drive in matrix_drives.drives(options.number)[:3])
        raise UsageError(f"no drive of the matrix is called {options.only!r}; they are called {names}, ...")
    dofs = matrix.DOFS if options.dof is None else (int(options.dof),)
    settings = Settings(dofs, options.frames, options.depth or CalibrationConfig().depth.model)
    rows = {drive.name: row for drive in drives if (row := _kept(options.output, drive, settings)) is not None}
    waiting = [drive for drive in drives if drive.name not in rows]
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(drives), completed=len(rows), note="")
        for row in finished(partial(matrix_run.run, settings=settings), waiting, options.jobs):
            output.write(_path(options.output, row.name), to_json(row))
            rows[row.name] = row
            bars.update(task, advance=1, note=row.name)
    report = matrix.report([rows[drive.name] for drive in drives])
    output.write(options.output / "report.json", to_json(report))
    output.write(options.output / "normalised.png", matrix_plots.normalised(report))
    if options.as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        matrix_tables.show(report)
    return 0


def _path(folder: Path, name: str) -> Path:
    return folder / "drives" / f"{name}.json"


def _kept(folder: Path, drive: MatrixDrive, settings: Settings) -> MatrixRow | None:
    """The row of a drive that was run before with these settings; None if there is none, or it is damaged."""
    row = output.kept(_path(folder, drive.name), MatrixRow)
    return row if row is not None and row.settings == settings.fingerprint else None
