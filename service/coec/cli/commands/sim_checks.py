"""What `coec sim checks` takes."""

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
    rounds: Annotated[
        int,
        typer.Option(help="Number of drives in every place with every rig, each with another seed.", min=1, max=10_000),
    ] = 4
    first: Annotated[
        int,
        typer.Option(
            "--first-round",
            help="The round to begin with: earlier ones may have been looked at when rules were chosen.",
            min=1,
            max=10_000,
            metavar="N",
        ),
    ] = 1
    hours: Annotated[
        float,
        typer.Option(help="Hours of driving to resample from these drives, whole drives at a time.", min=0, max=10_000),
    ] = 100.0
    jobs: Jobs = None
    as_json: Json = False


def run(options: Options) -> int:
    """Measure on rendered drives how often the monitor accuses a right mount, and how soon it notices a wrong one.

    A drive is 25 s of one rig in one place, checked at the true pose and at poses beside it; it takes a quarter of a
    minute of one core, a round 40 of them. For what no drive has met, a tail is fitted to how far off places are.
    Finished drives are kept in DIR: call again, with more rounds, to go on. A DIR holds results of one state of the
    code.
    """
    from coec_lab.commands import sim_checks as work

    return work.run(options)
