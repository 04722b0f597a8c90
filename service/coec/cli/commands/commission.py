"""What `coec commission` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import SOURCE_HELP, DegreesOfFreedom, Depth, Frames, Json, Objective


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    sources: Annotated[list[str], typer.Argument(metavar="SOURCE...", help=SOURCE_HELP, show_default=False)]
    output: Annotated[
        Path,
        typer.Option(
            help="Baseline to write, or to add the pair to; a report page is written beside it.", metavar="FILE"
        ),
    ] = Path("rig.json")
    depth: Depth = None
    objective: Objective = None
    dof: Annotated[DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.")] = None
    frames: Frames = None
    false_alarm_rate: Annotated[
        float, typer.Option(help="Fraction of checks at a right extrinsic that may be flagged.", min=1e-4, max=0.2)
    ] = 0.01
    sensors: Annotated[
        list[str] | None,
        typer.Option(
            "--sensor",
            help="Serial number of a sensor: camera=SERIAL or lidar=SERIAL; repeatable.",
            metavar="STREAM=SERIAL",
            show_default=False,
        ),
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Learn the baseline of a rig from windows in which its calibration is right: bias, spread, every limit."""
    from coec.cli import commission as work

    return work.run(options)
