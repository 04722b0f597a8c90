"""Options of several commands. Each option is declared once, here or in the module of its only command.

The imports decide how long a help text takes, so nothing heavy may be imported here or in `commands`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from coec.cli import completing

SOURCE_HELP = (
    "a recorded window or ROS 2 bag (.mcap), kitti360:ROOT?camera=image_00, kitti-raw:ROOT?..., a folder or "
    "dataset.yaml, sim:seed=1&seconds=60"
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output, nothing else.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite files that are there already.")]
Source = Annotated[str, typer.Argument(metavar="SOURCE", help=SOURCE_HELP, show_default=False)]
ConfigFile = Annotated[
    Path,
    typer.Option(
        "--config",
        help="Configuration of the daemon (YAML).",
        metavar="FILE",
        show_default=False,
        readable=False,  # whoever reads it says what is wrong, and ends with 78
    ),
]
DEFAULT_CONNECT = "tcp/127.0.0.1:7447"
"""The same as in `config`, which takes too long to import for a help text."""

Connect = Annotated[
    str | None, typer.Option(help="Zenoh endpoint of the router.", metavar="ENDPOINT", show_default=DEFAULT_CONNECT)
]

Jobs = Annotated[
    int | None, typer.Option(help="Number of processes, of one core and 1 GB each.", min=1, show_default="the cores")
]
"""Option of commands that draw many drives."""

DegreesOfFreedom = Literal["3", "6"]
"""Degrees of freedom of a search: rotation only, or translation too."""

Depth = Annotated[
    str | None,
    typer.Option(
        help="An ONNX file, a built-in name (`coec models`), or `stereo` for the depth maps of the source. Default: "
        "the network that a recorded window names, else the one that comes with coec.",
        metavar="MODEL",
        autocompletion=completing.depth_models,
    ),
]
Objective = Annotated[
    str | None,
    typer.Option(
        help="Objective to maximise: fused (edges and depth), mi (the paper) or intensity.",
        metavar="NAME",
        autocompletion=completing.objectives,
    ),
]
CameraModel = Annotated[
    str | None,
    typer.Option(
        help="Fit this model to the camera and use it: double_sphere. Refused if it does not fit the lens.",
        metavar="NAME",
        autocompletion=completing.camera_models,
    ),
]
Frames = Annotated[
    int | None, typer.Option(help="Use at most this many camera frames, evenly chosen.", min=1, show_default="25")
]
NoMotionCompensation = Annotated[
    bool, typer.Option("--no-motion-compensation", help="Use the clouds as they were recorded.")
]

# Options about a running service.
ServiceConfig = Annotated[
    Path | None,
    typer.Option(
        "--config", help="Configuration of the service; names the vehicle, the prefix and the router.", metavar="FILE"
    ),
]
Vehicle = Annotated[str | None, typer.Option(help="Name of the vehicle.", show_default="vehicle")]
Prefix = Annotated[str | None, typer.Option(help="Prefix of all keys.", show_default="coec")]
SessionFile = Annotated[
    Path | None,
    typer.Option(
        "--zenoh",
        help="Zenoh configuration of the session (JSON5): endpoint, certificate.",
        metavar="FILE",
        readable=False,  # as `ConfigFile`
    ),
]
RouterTimeout = Annotated[float, typer.Option("--timeout", help="Seconds to wait for the router.", min=0.01)]

# Options about a simulated vehicle.
Seed = Annotated[int, typer.Option(help="Seed of the drive: the same seed gives the same bytes.", min=0)]
SimCamera = Annotated[
    str,
    typer.Option(
        help="fisheyeW (185°, W×W pixels), pinholeWxH (90° wide) or pinholeWxH@D (D degrees wide).", metavar="CAMERA"
    ),
]
SimScene = Annotated[str, typer.Option(help="street, highway, garage or room.", metavar="SCENE")]
SimSpeed = Annotated[
    float | None,
    typer.Option("--speed", help="Mean speed, m/s; 0 stands still. Default: as usual in the scene.", min=0, max=45),
]
Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        help="KIND:BEGIN[-END][:KEY=VALUE,...], repeatable: step:30:rx=3, drift:30-90:ry=2, "
        "swing:30-90:rx=1,period_s=2, dirt, dark, frozen, lidar_frozen, beams, no-ego, zero-ego, offset, "
        "offset_drift:10-60:seconds=0.05, loss; poor stretches: tunnel:20-35, open_road:20-50, night:20-60, "
        "rain:20-60:mmph=20, low_sun:20-60.",
        metavar="FAULT",
    ),
]
