"""What `coec diagnose` takes."""

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
    depth: Depth = None
    rig: Annotated[
        Path | None, typer.Option(help="Baseline from `coec commission`.", metavar="FILE", show_default=False)
    ] = None
    perturb: Annotated[
        str | None,
        typer.Option(help="Move the extrinsic: degrees and metres.", metavar="RX,RY,RZ[,TX,TY,TZ]"),
    ] = None
    detection: Annotated[
        int,
        typer.Option(
            help="Instead, print how well moved extrinsics are detected, over N splits of the pairs.",
            metavar="N",
            min=0,
        ),
    ] = 0
    checks: Annotated[int, typer.Option(help="Checks per split and move, with --detection.", min=1)] = 10
    frames: Frames = None
    output: Annotated[
        Path | None, typer.Option(help="Write report.html and overlay.png.", metavar="DIR", show_default=False)
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Check the extrinsic of a recording, as the service does every few seconds: exit 1 if it is wrong or undecided."""
    from coec.cli import diagnose as work

    return work.run(options)
