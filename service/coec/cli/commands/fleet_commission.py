"""What `coec fleet commission` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    baselines: Annotated[
        list[Path],
        typer.Argument(
            metavar="RIG...", help="rig.json files of commissioned vehicles of one model.", show_default=False
        ),
    ]
    output: Annotated[Path, typer.Option(help="File to write: the baselines of the model.", metavar="FILE")] = Path(
        "model.json"
    )
    as_json: Json = False


def run(options: Options) -> int:
    """Learn from commissioned vehicles what others of their model start from (`state.model`): bias, spread, limits."""
    from coec.cli import fleet_commission as work

    return work.run(options)
