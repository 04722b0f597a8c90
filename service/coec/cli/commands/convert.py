"""What `coec convert` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json, Source


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: Source
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="OUT.mcap: one ROS 2 MCAP of all frames. OUT.yaml: a daemon configuration for this recording.",
            show_default=False,
        ),
    ]
    as_json: Json = False


def run(options: Options) -> int:
    """Turn a recording into a ROS 2 MCAP, or into a configuration with which `run` serves it."""
    from coec.cli import convert as work

    return work.run(options.source, options.out, as_json=options.as_json)
