"""What `coec warmup` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    config: Annotated[
        Path | None,
        typer.Option(
            help="Compile for the lenses in this configuration of the daemon (YAML); default: for every lens model.",
            metavar="FILE",
            show_default=False,
        ),
    ] = None
    lenses: Annotated[
        list[str] | None,
        typer.Option(
            "--lens",
            help="Compile for this lens model, such as pinhole; repeatable.",
            metavar="MODEL",
            show_default=False,
        ),
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Compile the kernels that the service and the calibration use, so that no first start has to.

    They are kept in the cache of the user who runs the command, for processors like this one. What is there already is
    not compiled again.
    """
    from coec.cli import warmup as work

    return work.run(options)
