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
            help="Of a vehicle with four cameras: a knocked LiDAR and a knocked camera, told apart. Pictures have 700 "
            "pixels a side; what looks and tells is the service's, here without the service around it.",
        ),
    ] = False
    as_json: Json = False


def run(options: Options) -> int:
    """A simulated vehicle whose mount is knocked, and the service that notices and repairs it: no data, two minutes."""
    if options.rig:
        from coec.cli.demo import rig

        return rig.run(options.output, as_json=options.as_json)
    from coec.cli import demo as work

    return work.run(options.output, as_json=options.as_json)
