"""What `coec fetch` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Connect, Json, Prefix, SessionFile


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    vehicle: Annotated[str, typer.Argument(metavar="VEHICLE", help="Its name.", show_default=False)]
    event: Annotated[
        str | None,
        typer.Argument(
            metavar="EVENT",
            help="Id of a red event, or `latest`; without it, those that the vehicle keeps are listed.",
            show_default=False,
        ),
    ] = None
    pair: Annotated[str | None, typer.Option(help="Of which pair events are looked for.", show_default="all")] = None
    prefix: Prefix = None
    connect: Connect = None
    zenoh: SessionFile = None
    output: Annotated[Path | None, typer.Option(help="Folder.", metavar="DIR", show_default="VEHICLE-EVENT")] = None
    no_windows: Annotated[bool, typer.Option("--no-windows", help="Leave the recordings where they are.")] = False
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Seconds to wait, for the router and for each answer.", min=0.1)
    ] = 10.0
    patience_s: Annotated[
        float,
        typer.Option("--patience", help="Seconds without a piece of a window before it is given up.", min=0.1),
    ] = 120.0
    as_json: Json = False


def run(options: Options) -> int:
    """Bring a red event home: one folder with pictures, recordings, history, and a page that tells its story.

    What has come is kept: the same command goes on where the link broke.
    """
    from coec.cli import fetch as work

    return work.run(options)
