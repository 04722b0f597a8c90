"""What `coec sim matrix` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import DegreesOfFreedom, Depth, Jobs, Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    output: Annotated[
        Path,
        typer.Option(help="Folder for report.json, normalised.png and drives/.", metavar="DIR", show_default=False),
    ]
    number: Annotated[
        int,
        typer.Option(
            "--round",
            help="The same kinds of drives, each round with seeds of its own.",
            min=1,
            max=10_000,
            metavar="N",
        ),
    ] = 1
    only: Annotated[
        str | None,
        typer.Option(
            help="Drives whose name fits: scene_lens_lidar_light_fault_sN with * and ?, as '*_night_*' or '*_s1'.",
            metavar="PATTERN",
        ),
    ] = None
    dof: Annotated[
        DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.", show_default="both")
    ] = None
    frames: Annotated[int, typer.Option(help="Pairs of a window; a drive has two windows.", min=2, max=100)] = 10
    depth: Depth = None
    jobs: Jobs = None
    as_json: Json = False


def run(options: Options) -> int:
    """Try estimator and monitor on simulated drives: scenes, lenses, LiDARs, light, faults.

    A drive takes about half a minute of one core, the whole matrix most of an hour. What is done is kept in DIR: call
    again to go on. A DIR holds results of one state of the code; take another after a change.
    """
    from coec.cli import sim_matrix as work

    return work.run(options)
