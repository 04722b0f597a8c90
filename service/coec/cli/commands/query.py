"""What `coec query` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Connect, Json, Prefix, ServiceConfig, Vehicle


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    key: Annotated[
        str,
        typer.Argument(
            help="extrinsic, health, history, windows, windows/ID, status, config, metrics, command/NAME, or a whole "
            "key expression with @v1 in it.",
            show_default=False,
        ),
    ]
    pair: Annotated[
        str | None, typer.Option(help="All pairs if not given; needed for commands if there are several.")
    ] = None
    config: ServiceConfig = None
    vehicle: Vehicle = None
    prefix: Prefix = None
    connect: Connect = None
    zenoh: Annotated[
        Path | None,
        typer.Option(
            help="Zenoh configuration (JSON5) to connect with; with its certificate commands are proven.",
            metavar="FILE",
        ),
    ] = None
    anonymous: Annotated[bool, typer.Option("--anonymous", help="Give a command without proof of who gives it.")] = (
        False
    )
    params: Annotated[
        list[str] | None,
        typer.Option("--param", help="Parameter of the query, for example limit=5; repeatable.", metavar="K=V"),
    ] = None
    payload: Annotated[str | None, typer.Option(help="Payload of a command, JSON.")] = None
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Seconds to wait, for the router and for the answer.", min=0.01)
    ] = 5.0
    output: Annotated[
        Path | None, typer.Option(help="Download windows/ID into this file and verify its sha256.", metavar="FILE")
    ] = None
    as_json: Json = False


def run(options: Options) -> int:
    """Ask a running service."""
    from coec.cli import query as work

    return work.run(options)
