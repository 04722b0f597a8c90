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
        int, typer.Option(help="Drives in every place with every rig, each of another seed.", min=1, max=10_000)
    ] = 4
    hours: Annotated[
        float, typer.Option(help="Hours of driving to resample from them, whole drives at a time.", min=0, max=10_000)
    ] = 100.0
    jobs: Jobs = None
    as_json: Json = False


def run(options: Options) -> int:
    """Tell how often the monitor accuses a right mount on rendered drives, and how soon it notices a wrong one.

    A drive is 25 s of one rig in one place, looked at from the truth and from beside it; it takes a quarter of a minute
    of one core, a round 40 of them. What no drive met is told by a tail that is fitted to how far off places are. What
    is done is kept in DIR: call again, with more rounds, to go on. A DIR holds results of one state of the code.
    """
    from coec.cli import sim_checks as work

    return work.run(options)
