"""What `coec alarms` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    hours: Annotated[float, typer.Option(help="Hours of driving with a right mount.", min=0.1)] = 100.0
    steps: Annotated[int, typer.Option(help="Number of drawn steps of each size.", min=1)] = 20
    period_s: Annotated[float, typer.Option("--period", help="Seconds between checks.")] = 5.0
    between_h: Annotated[float, typer.Option("--between", help="Configured hours between false alarms.")] = 100.0
    output: Annotated[
        Path | None, typer.Option(help="Folder for alarms.json and delay.png.", metavar="DIR", show_default=False)
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Estimate from drawn checks how often the monitor accuses a right mount, and how soon it notices a moved one."""
    from coec_lab.commands import alarms as work

    return work.run(options)
