"""What `coec router` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.stopping import ended_by_sigterm


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    config: Annotated[
        Path,
        typer.Option(
            help="Zenoh configuration of a router (JSON5).", metavar="FILE", show_default=False, readable=False
        ),
    ]


def run(options: Options) -> int:
    """Run a Zenoh router for the vehicle, with the access control of its configuration (deploy/router.json5)."""
    with ended_by_sigterm():
        from coec.cli import router as work

        return work.run(options.config)
