"""What `coec replay` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    window: Annotated[Path, typer.Argument(help="A recorded window with its result (.mcap).", show_default=False)]
    depth: Annotated[
        str | None, typer.Option(help="Depth network, if it has moved since the window was recorded.", metavar="MODEL")
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Reproduce the recorded decision from the file alone: exit 1 if a byte of it differs."""
    from coec.cli import replay as work

    return work.run(options.window, depth=options.depth, as_json=options.as_json)
