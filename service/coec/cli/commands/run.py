"""What `coec run` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import ConfigFile
from coec.cli.stopping import ended_by_sigterm


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    config: ConfigFile
    embedded_router: Annotated[
        bool, typer.Option("--embedded-router", help="Also be the Zenoh router, listening on `zenoh.listen`.")
    ] = False
    state_dir: Annotated[
        Path | None, typer.Option(help="State directory, instead of `state.directory`.", metavar="DIR")
    ] = None


def run(options: Options) -> int:
    """Run the service until SIGTERM or SIGINT; SIGHUP reads the configuration again. Logs go to standard output."""
    with ended_by_sigterm():
        from coec.cli import run as work

        return work.run(options.config, embedded_router=options.embedded_router, state_dir=options.state_dir)
