"""What `coec convert` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Force, Json, Source


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
    full: Annotated[
        bool,
        typer.Option("--full", help="OUT.yaml with every key and a comment on each, not only what has no default."),
    ] = False
    force: Force = False
    as_json: Json = False


def run(options: Options) -> int:
    """Turn a recording into a ROS 2 MCAP, or into a configuration with which `run` serves it."""
    from coec.cli import convert as work

    return work.run(options)
