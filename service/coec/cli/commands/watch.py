"""What `coec watch` takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from coec.cli.options import Connect, Prefix, RouterTimeout, ServiceConfig, SessionFile


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    config: ServiceConfig = None
    vehicle: Annotated[
        str | None, typer.Option(help="Show only this vehicle.", show_default="all of them; `vehicle` for lines")
    ] = None
    prefix: Prefix = None
    connect: Connect = None
    zenoh: SessionFile = None
    states: Annotated[
        list[str] | None,
        typer.Option("--state", help="Only pairs in this state, or `parked`, `silent`; repeatable.", metavar="STATE"),
    ] = None
    find: Annotated[str | None, typer.Option(help="Only pairs with this text in VEHICLE/PAIR.", metavar="TEXT")] = None
    once: Annotated[bool, typer.Option("--once", help="Print the board once, and end.")] = False
    lines: Annotated[
        bool,
        typer.Option(
            "--lines", help="Print one line per change of one vehicle, as when standard output is no terminal."
        ),
    ] = False
    seconds: Annotated[
        float | None,
        typer.Option(
            help="Print lines for this many seconds: exit 1 if nothing was heard.", min=0.1, show_default="for ever"
        ),
    ] = None
    timeout_s: RouterTimeout = 5.0
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print one JSON document per line on standard output; with --once, one document."),
    ] = False


def run(options: Options) -> int:
    """Show every vehicle's pairs by urgency, as they change: state, age, drift, reasons. Sends no command.

    In a terminal: r reasons, h history, o overlay of the chosen pair, f filter, q quit. If the output is no terminal: a
    line for each change of health, extrinsic and presence of one vehicle.
    """
    from coec.cli import watch as work

    return work.run(options)
