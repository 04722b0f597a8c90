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
        str, typer.Argument(help="Topic (of a rig, name) of the denser LiDAR.", metavar="A", show_default=False)
    ]
    b: Annotated[str, typer.Argument(help="Of the one whose pose in A is told.", metavar="B", show_default=False)]
    pairs: Annotated[int, typer.Option(help="Pairs of sweeps, evenly over the recording.", min=1, max=200)] = 12
    as_json: Json = False


def run(options: Options) -> int:
    """Where one LiDAR of a vehicle sits from another, of the surfaces that both see: exit 1 if those are too few."""
    from coec.cli import lidars as work

    return work.run(options)
