"""What `coec models show` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    file: Annotated[Path, typer.Argument(help="An ONNX file.", metavar="FILE", show_default=False)]
    as_json: Json = False


def run(options: Options) -> int:
    """Show the model card with which a network file is run."""
    from coec.cli import models as work

    return work.show(options.file, as_json=options.as_json)
