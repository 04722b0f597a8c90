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

    vehicle: Annotated[str, typer.Argument(metavar="VEHICLE", help="Name of the vehicle.", show_default=False)]
    event: Annotated[
        str | None,
        typer.Argument(
            metavar="EVENT",
            help="Id of a red event, or `latest`; without it, the vehicle's red events are listed.",
            show_default=False,
        ),
    ] = None
    pair: Annotated[str | None, typer.Option(help="Pair whose events are searched.", show_default="all")] = None
    prefix: Prefix = None
    connect: Connect = None
    zenoh: SessionFile = None
    output: Annotated[
        Path | None, typer.Option(help="Folder to write.", metavar="DIR", show_default="VEHICLE-EVENT")
    ] = None
    no_windows: Annotated[bool, typer.Option("--no-windows", help="Do not download the recordings.")] = False
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Seconds to wait for the router and for each answer.", min=0.1)
    ] = 10.0
    patience_s: Annotated[
        float,
        typer.Option("--patience", help="Seconds without a piece of a window before giving up.", min=0.1),
    ] = 120.0
    as_json: Json = False


def run(options: Options) -> int:
    """Fetch a red event as one folder with pictures, recordings, history, and a page that tells its story.

    What has arrived is kept: the same command resumes where the link broke.
    """
    from coec.cli import fetch as work

    return work.run(options)
