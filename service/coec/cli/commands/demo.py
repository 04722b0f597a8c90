"""What `coec demo` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    output: Annotated[Path, typer.Option(help="Folder for pictures, window and result.", metavar="DIR")] = Path(
        "coec-demo"
    )
    rig: Annotated[
        bool,
        typer.Option(
            "--rig",
            help="Show a vehicle with four cameras instead: a running service tells a knocked LiDAR from a knocked "
            "camera. Pictures have 700 pixels a side.",
        ),
    ] = False
    as_json: Json = False


def run(options: Options) -> int:
    """Knock the mount of a simulated vehicle and show the service notice and repair it: no data, two minutes."""
    if options.rig:
        from coec_lab.demo import rig

        return rig.run(options.output, as_json=options.as_json)
    from coec_lab import demo as work

    return work.run(options.output, as_json=options.as_json)
