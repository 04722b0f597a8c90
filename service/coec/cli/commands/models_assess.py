"""What `coec models assess` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Frames, Json, Source


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    model: Annotated[
        str,
        typer.Argument(help="An ONNX file, a built-in name, or `stereo`.", metavar="MODEL", show_default=False),
    ]
    source: Source
    frames: Frames = None
    output: Annotated[
        Path | None, typer.Option(help="Write curves.png, joint.png, frame.png and report.json.", metavar="DIR")
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Compare a depth network with the LiDAR of a calibrated recording: exit 1 if it is of no use there."""
    from coec_lab.commands import assess as work

    return work.run(options)
