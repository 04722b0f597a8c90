"""What `coec check-config` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    file: Annotated[Path | None, typer.Argument(help="Configuration (YAML).", show_default=False, readable=False)] = (
        None
    )
    defaults: Annotated[bool, typer.Option("--defaults", help="Print a commented template instead.")] = False
    as_json: Json = False


def run(options: Options) -> int:
    """Print the effective configuration with every default; exit 78 if it, or a file it names, cannot be used."""
    from coec.cli import check_config as work

    return work.run(options.file, defaults=options.defaults, as_json=options.as_json)
