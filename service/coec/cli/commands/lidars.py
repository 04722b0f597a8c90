"""What `coec lidars` takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: Annotated[
        str,
        typer.Argument(help="A ROS 2 bag, or sim:rig=four-fisheyes&seconds=60.", metavar="SOURCE", show_default=False),
    ]
    a: Annotated[
        str,
        typer.Argument(
            help="Topic of the denser LiDAR; for a simulated rig, its name.", metavar="A", show_default=False
        ),
    ]
    b: Annotated[
        str, typer.Argument(help="The same of the LiDAR whose pose in A is estimated.", metavar="B", show_default=False)
    ]
    pairs: Annotated[
        int, typer.Option(help="Number of pairs of sweeps, spread evenly over the recording.", min=1, max=200)
    ] = 12
    as_json: Json = False


def run(options: Options) -> int:
    """Find the pose of one LiDAR in another from the surfaces that both see: exit 1 if those are too few."""
    from coec.cli import lidars as work

    return work.run(options)
