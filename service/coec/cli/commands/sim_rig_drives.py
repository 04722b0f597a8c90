"""What `coec sim rig-drives` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Jobs, Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    output: Annotated[Path, typer.Option(help="Folder for report.json and drives/.", metavar="DIR", show_default=False)]
    drives: Annotated[int, typer.Option(help="Number of drives, each with every fault.", min=1, max=10_000)] = 30
    camera: Annotated[str, typer.Option(help="Model of every camera of the rig: fisheyeW.", metavar="NAME")] = (
        "fisheye700"
    )
    jobs: Jobs = None
    as_json: Json = False


def run(options: Options) -> int:
    """Measure on rendered drives how well the sensors of a rig that moved are named, and no others.

    A drive is a minute and a half of a street with four fisheyes and a LiDAR, drawn as the rig was built and with two
    cameras and the LiDAR knocked by 1°; it takes some minutes of one core. Pairs that suspect a move have a window, as
    on the vehicle. Only the image rows that the LiDAR sees are rendered. Finished drives are kept in DIR: call again,
    with more drives, to go on. A DIR holds results of one state of the code.
    """
    from coec_lab.commands import sim_rig_drives as work

    return work.run(options)
