"""What `coec paper` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Depth, Frames, Json, Source


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: Source
    output: Annotated[
        Path, typer.Option(help="Folder for report.html, report.json and the figures.", metavar="DIR")
    ] = Path("coec-paper")
    depth: Depth = None
    objective: Annotated[str, typer.Option(help="mi (the paper's) or fused.", metavar="NAME")] = "mi"
    runs: Annotated[int, typer.Option(help="Number of solves per experiment.", min=1)] = 100
    samples: Annotated[int, typer.Option(help="Number of samples of pairs for the failure metrics.", min=3)] = 100
    frames: Frames = None
    slice_s: Annotated[
        float | None, typer.Option(help="Cut the drive into windows of 25 pairs, each over this many seconds.", min=1.0)
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Repeat the published experiments on a recording: metrics.png, bullseye.png, drive.png."""
    from coec_lab.commands import paper as work

    return work.run(options)
