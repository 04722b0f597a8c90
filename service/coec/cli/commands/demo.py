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
    as_json: Json = False


def run(options: Options) -> int:
    """A simulated vehicle whose mount is knocked, and the service that notices and repairs it: no data, two minutes."""
    from coec.cli import demo as work

    return work.run(options.output, as_json=options.as_json)
