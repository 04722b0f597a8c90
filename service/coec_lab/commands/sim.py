"""`coec sim`: its commands; `drive` and `view` write simulated drives to files."""

from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Faults, Force, Json, Seed, SimCamera, SimScene, SimSpeed
from coec_lab.commands import sim_checks, sim_matrix, sim_rig


def _exit(status: int) -> None:
    raise typer.Exit(status)


app = typer.Typer(no_args_is_help=True, help="Simulate a vehicle (optional extra `sim`).", result_callback=_exit)


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
        rolling_shutter_s, intrinsics_off, tuple(faults or ()),
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


app.command("matrix")(sim_matrix.matrix)
app.command("checks")(sim_checks.checks)
app.command("rig-moves")(sim_rig.rig_moves)
app.command("rig-drives")(sim_rig.rig_drives)
