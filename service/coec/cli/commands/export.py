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
    parent: Annotated[str | None, typer.Option(help="Frame to write it in.", show_default="the LiDAR's")] = None
    child: Annotated[str | None, typer.Option(help="Frame of the camera.", show_default="the camera's")] = None
    parent_pose: Annotated[
        str | None,
        typer.Option(
            help="Pose of the LiDAR in the parent: metres and a quaternion.",
            metavar="X,Y,Z,QX,QY,QZ,QW",
            show_default="the LiDAR is the parent",
        ),
    ] = None
    pair: Annotated[str | None, typer.Option(help="Which pair, where there are several.")] = None
    config: Annotated[
        Path | None, typer.Option(help="Configuration of the daemon, for intrinsics and frames.", metavar="FILE")
    ] = None
    output: Annotated[
        Path | None,
        typer.Option(
            help="Write there, at once or not at all; of a file that holds others, this entry alone is changed. "
            "Otherwise it is printed.",
            metavar="FILE",
        ),
    ] = None
    force: Annotated[bool, typer.Option("--force", help="Also what is not accepted; the file says so.")] = False
    as_json: Json = False


def run(options: Options) -> int:
    """Write a calibration into the files of other programs: exit 1 if it is not accepted."""
    from coec.cli import export as work

    return work.run(options)
