"""What `coec models add` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Force, Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    file: Annotated[Path, typer.Argument(help="The ONNX file of a known network.", metavar="FILE", show_default=False)]
    name: Annotated[
        str | None,
        typer.Option(
            "--as", help="Network that the file is an export of, if its sha256 and name do not say so.", metavar="NAME"
        ),
    ] = None
    force: Force = False
    as_json: Json = False


def run(options: Options) -> int:
    """Copy the file of a known depth network to where this user's services look for it, after checking it."""
    from coec.cli import models as work

    return work.add(options.file, options.name, force=options.force, as_json=options.as_json)
