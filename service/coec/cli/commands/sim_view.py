"""What `coec sim view` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Faults, Json, Seed, SimCamera, SimScene, SimSpeed


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    output: Annotated[Path, typer.Option(help="Picture to write.", metavar="FILE.jpg", show_default=False)]
    seed: Seed = 0
    at_s: Annotated[float, typer.Option(help="Seconds into the drive.", min=0)] = 0.0
    camera: SimCamera = "fisheye700"
    scene: SimScene = "street"
    speed_mps: SimSpeed = None
    faults: Faults = None
    as_json: Json = False


def run(options: Options) -> int:
    """Write one picture of a drive."""
    from coec_lab.commands import sim as work

    return work.view(options)
