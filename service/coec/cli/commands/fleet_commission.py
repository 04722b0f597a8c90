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
            metavar="RIG...", help="rig.json of commissioned vehicles of one model, a file each.", show_default=False
        ),
    ]
    output: Annotated[Path, typer.Option(help="Baselines of the model to write.", metavar="FILE")] = Path("model.json")
    as_json: Json = False


def run(options: Options) -> int:
    """Learn from commissioned vehicles what one of the same model starts from (`state.model`): bias, spread, limits."""
    from coec.cli import fleet_commission as work

    return work.run(options)
