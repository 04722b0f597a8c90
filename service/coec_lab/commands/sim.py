"""`coec sim`: its commands. `drive` and `view` write simulated drives to files; `matrix`, `checks`, `rig-drives` and
`rig-moves` run estimator and monitor on many of them and make tables of the results.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import DegreesOfFreedom, Depth, Faults, Force, Jobs, Json, Seed, SimCamera, SimScene, SimSpeed

if TYPE_CHECKING:
    from collections.abc import Collection

    from coec.calibration.baseline import Baseline
    from coec.errors import CalibrationError
    from coec_lab.experiments.matrix_drives import MatrixDrive, Settings


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
    from coec.io import user_files
    from coec.reports import console
    from coec.schemas.message import to_json
    from coec_lab.commands.drive_pool import drive_file, finished, resumed
    from coec_lab.experiments import rig_drives, rig_moves
    from coec_lab.experiments.rig_drives import DisplacedRigDrive
    from coec_lab.experiments.simulation_schemas import RigDriveRow
    from coec_lab.simulation.source import require_embree

    require_embree()
    planned = [DisplacedRigDrive(number, camera) for number in range(drives)]
    names = [drive.name for drive in planned]
    rows = resumed(output, names, RigDriveRow)
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(names), completed=len(rows), note="")
        pending = [drive for drive in planned if drive.name not in rows]
        for row in finished(rig_drives.driven, pending, jobs):
            user_files.replace_output(drive_file(output, row.name), to_json(row))
            rows[row.name] = row
            bars.update(task, advance=1, note=row.name)
    report = rig_drives.report([rows[name] for name in names], camera)
    user_files.write_output(output / "report.json", to_json(report))
    console.report(report, lambda: rig_moves.show_drives(report), as_json=as_json)
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

    with console.progress() as bars:
        task = bars.add_task("drives", total=len(rig_moves.FAULTS) * drives, note="")
        report = rig_moves.report(drives, rigs, lambda note: bars.update(task, advance=1, note=note))
    console.report(report, lambda: rig_moves.show(report), as_json=as_json)
    return 0


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
    from coec.io import user_files
    from coec.reports import console
    from coec.schemas.message import to_json
    from coec_lab.commands.drive_pool import drive_file, finished, resumed
    from coec_lab.experiments import matrix_drives, matrix_statistics, plots
    from coec_lab.experiments.simulation_schemas import MatrixRow
    from coec_lab.simulation.source import require_embree

    require_embree()
    drives, settings = _selected(number, only, None if dof is None else int(dof), frames, depth)
    names = [drive.name for drive in drives]
    rows = resumed(output, names, MatrixRow, lambda row: row.settings == settings.fingerprint)
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(drives), completed=len(rows), note="")
        pending = [drive for drive in drives if drive.name not in rows]
        for row in finished(partial(matrix_drives.run, settings=settings), pending, jobs):
            user_files.write_output(drive_file(output, row.name), to_json(row))
            rows[row.name] = row
            bars.update(task, advance=1, note=row.name)
    report = matrix_statistics.report([rows[name] for name in names])
    user_files.write_output(output / "report.json", to_json(report))
    user_files.write_output(output / "normalised.png", plots.matrix_errors(report))
    console.report(report, lambda: matrix_statistics.show(report), as_json=as_json)
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
    from coec.io import user_files
    from coec.reports import console
    from coec.schemas.message import to_json
    from coec_lab.commands.drive_pool import drive_file, finished, resumed
    from coec_lab.experiments import check_drives, check_statistics
    from coec_lab.experiments.simulation_schemas import CheckedDrive
    from coec_lab.simulation.source import require_embree

    require_embree()
    series = list(check_drives.drives(rounds, first))
    names = [drive.name for outing in series for drive in outing]
    rows = resumed(output, names, CheckedDrive)
    unfinished = ([drive for drive in outing if drive.name not in rows] for outing in series)
    pending = [outing for outing in unfinished if outing]
    with console.progress() as bars:
        task = bars.add_task("drives", total=len(names), completed=len(rows), note="commissioning")
        baselines = _baselines({drive.rig for outing in pending for drive in outing}, jobs)
        for outing in finished(partial(check_drives.run, baselines=baselines), pending, jobs):
            for row in outing:
                user_files.write_output(drive_file(output, row.name), to_json(row))
                rows[row.name] = row
                bars.update(task, advance=1, note=row.name)
    report = check_statistics.report([rows[name] for name in names], hours)
    user_files.write_output(output / "report.json", to_json(report))
    console.report(report, lambda: check_statistics.show(report), as_json=as_json)
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
    from coec_lab.experiments import check_drives

    try:
        return rig, check_drives.commissioned(rig)
    except CalibrationError as error:
        return rig, error


def _exit(status: int) -> None:
    raise typer.Exit(status)


app = typer.Typer(no_args_is_help=True, help="Simulate a vehicle.", result_callback=_exit)


Intensity = Annotated[
    str | None,
    typer.Option(
        help="What the LiDAR writes of reflectance: calibrated, reflectivity, raw, coarse or none.",
        metavar="KIND",
        show_default="as usual for the LiDAR",
    ),
]


@app.command("drive")
def drive(
    output: Annotated[
        Path,
        typer.Option(help="ROS 2 MCAP to write; for a rig, the folder.", metavar="FILE.mcap|DIR", show_default=False),
    ],
    rig: Annotated[
        str | None,
        typer.Option(
            help="Several cameras and LiDARs on one vehicle: four-fisheyes. A fault then begins with the sensor's "
            "name: front:step:40:ry=1, roof:step:40:rz=1, about the sensor's own axes.",
            metavar="RIG",
        ),
    ] = None,
    seed: Seed = 0,
    seconds: Annotated[float, typer.Option(help="Length of the drive.", min=0.1)] = 60.0,
    camera: SimCamera = "fisheye700",
    lidar: Annotated[
        str, typer.Option(help="Beams: 16, 32, 64, 128; or without rings: raster, rosette.", metavar="LIDAR")
    ] = "64",
    intensity: Intensity = None,
    scene: SimScene = "street",
    speed_mps: SimSpeed = None,
    go_s: Annotated[float, typer.Option("--go", help="Seconds of driving between two stops.", min=1)] = 20.0,
    stop_s: Annotated[
        float, typer.Option("--stop", help="Seconds for which it then stands; 0: no stops.", min=0)
    ] = 0.0,
    rolling_shutter_s: Annotated[
        float, typer.Option("--rolling-shutter", help="Seconds from the first image row to the last.", min=0, max=0.1)
    ] = 0.0,
    intrinsics_off: Annotated[
        str | None,
        typer.Option(
            help="Error of the configured focal length and principal point, percent.", metavar="FOCAL[,CX,CY]"
        ),
    ] = None,
    camera_hz: Annotated[float, typer.Option(help="Pictures per second.", min=0.01)] = 10.0,
    lidar_hz: Annotated[float, typer.Option(help="Sweeps per second.", min=0.01, max=10)] = 10.0,
    faults: Faults = None,
    workshop: Annotated[
        str | None,
        typer.Option(
            help="Error of the nominal calibration, degrees and metres; for a rig SENSOR:RX,RY,RZ;...",
            metavar="RX,RY,RZ[,TX,TY,TZ]",
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Write a drive as a ROS 2 bag; the truth is on /ground_truth/tf, next to the sensors.

    A bag has no place for a mask: its readers detect the vehicle's own body and the rim of the lens from the frames, if
    at least five are in motion.
    """
    from coec_lab.commands import drive_bags

    options = drive_bags.DriveOptions(
        seed, seconds, camera, scene, speed_mps, camera_hz, lidar_hz, workshop, rig, lidar, go_s, stop_s,
        rolling_shutter_s, intrinsics_off, intensity, tuple(faults or ()),
    )  # fmt: skip
    write = drive_bags.write_pair if rig is None else drive_bags.write_rig
    return write(options, output, force=force, as_json=as_json)


@app.command("view")
def view(
    output: Annotated[Path, typer.Option(help="Picture to write.", metavar="FILE.jpg", show_default=False)],
    seed: Seed = 0,
    at_s: Annotated[float, typer.Option(help="Seconds into the drive.", min=0)] = 0.0,
    camera: SimCamera = "fisheye700",
    scene: SimScene = "street",
    speed_mps: SimSpeed = None,
    faults: Faults = None,
    as_json: Json = False,
) -> int:
    """Write one picture of a drive."""
    from coec_lab.commands import drive_bags

    options = drive_bags.DriveOptions(
        seed=seed, seconds=at_s + 1.0, camera=camera, scene=scene, speed_mps=speed_mps, faults=tuple(faults or ())
    )
    return drive_bags.write_picture(options, at_s, output, as_json=as_json)


app.command("matrix")(matrix)
app.command("checks")(checks)
app.command("rig-moves")(rig_moves)
app.command("rig-drives")(rig_drives)
