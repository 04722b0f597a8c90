"""What `coec export` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli import completing
from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="A state directory, a recorded window (.mcap), the JSON of `calibrate` or of `query extrinsic`.",
            show_default=False,
        ),
    ]
    format: Annotated[
        str,
        typer.Option(
            "--format",
            help="tf, urdf, autoware, kalibr, kitti, kitti360, nuscenes, openlabel, colmap, opencv or json.",
            metavar="NAME",
            autocompletion=completing.export_formats,
            show_default=False,
        ),
    ]
    parent: Annotated[str | None, typer.Option(help="Parent frame in the file.", show_default="the LiDAR's")] = None
    child: Annotated[
        str | None, typer.Option(help="Name of the camera's frame in the file.", show_default="the camera's")
    ] = None
    parent_pose: Annotated[
        str | None,
        typer.Option(
            help="Pose of the LiDAR in the parent: metres and a quaternion.",
            metavar="X,Y,Z,QX,QY,QZ,QW",
            show_default="the LiDAR is the parent",
        ),
    ] = None
    pair: Annotated[str | None, typer.Option(help="Pair, if there are several.")] = None
    config: Annotated[
        Path | None, typer.Option(help="Configuration of the daemon, for intrinsics and frames.", metavar="FILE")
    ] = None
    output: Annotated[
        Path | None,
        typer.Option(
            help="File to write, completely or not at all; in a file with several entries only this one changes. "
            "Default: print it.",
            metavar="FILE",
        ),
    ] = None
    force: Annotated[
        bool, typer.Option("--force", help="Write a calibration that is not accepted, too; the file says so.")
    ] = False
    as_json: Json = False


def run(options: Options) -> int:
    """Write a calibration into the files of other programs: exit 1 if it is not accepted."""
    from coec.cli import export as work

    return work.run(options)
