"""What `coec sim rig-moves` takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    drives: Annotated[int, typer.Option(help="Number of drives for each fault.", min=1, max=10_000)] = 30
    rigs: Annotated[int, typer.Option(help="Number of rigs whose windows are combined.", min=1, max=10_000)] = 50
    as_json: Json = False


def run(options: Options) -> int:
    """Measure on drawn evidence of all pairs how well the sensors of a rig that moved are named, and no others.

    Nothing is rendered: checks and windows are drawn at random, with all the errors of real ones. A drive takes one to
    three seconds of a core.
    """
    from coec_lab.commands import sim_rig_moves as work

    return work.run(options.drives, options.rigs, as_json=options.as_json)
