"""What `coec calibrate` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import CameraModel, DegreesOfFreedom, Depth, Frames, Json, NoMotionCompensation, Objective, Source


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: Source
    depth: Depth = None
    objective: Objective = None
    dof: Annotated[DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.")] = None
    perturb: Annotated[
        str | None,
        typer.Option(
            help="Move the start: degrees and metres about and along the camera axes.", metavar="RX,RY,RZ[,TX,TY,TZ]"
        ),
    ] = None
    camera_model: CameraModel = None
    frames: Frames = None
    no_motion_compensation: NoMotionCompensation = False
    time_offset: Annotated[
        bool, typer.Option("--time-offset", help="Also estimate the offset of the camera's clock, if turns show it.")
    ] = False
    output: Annotated[
        Path | None,
        typer.Option(
            help="Write report.html, overlay_before.png, overlay_after.png, close_ups.png, residuals.png and "
            "result.json; with --camera-model also lens_residual.png, even if the model is refused.",
            metavar="DIR",
        ),
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Calibrate from a recording: exit 0 if the result is accepted, 1 if the self-diagnosis refuses it."""
    from coec.cli import calibrate as work

    return work.run(options)
