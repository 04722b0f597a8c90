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
            help="Round of the matrix: each has the same kinds of drives, with other seeds.",
            min=1,
            max=10_000,
            metavar="N",
        ),
    ] = 1
    only: Annotated[
        str | None,
        typer.Option(
            help="Only drives whose name matches; names are scene_lens_lidar_light_fault_sN: '*_night_*', '*_s1'.",
            metavar="PATTERN",
        ),
    ] = None
    dof: Annotated[
        DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.", show_default="both")
    ] = None
    frames: Annotated[int, typer.Option(help="Pairs per window; a drive has two windows.", min=2, max=100)] = 10
    depth: Depth = None
    jobs: Jobs = None
    as_json: Json = False


def run(options: Options) -> int:
    """Try estimator and monitor on simulated drives: scenes, lenses, LiDARs, light, faults.

    A drive takes about half a minute of one core, the whole matrix most of an hour. Finished drives are kept in DIR:
    call again to go on. A DIR holds results of one state of the code; take another after a change.
    """
    from coec_lab.commands import sim_matrix as work

    return work.run(options)
