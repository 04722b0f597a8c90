"""What `coec watch` takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from coec.cli.options import Connect, Prefix, RouterTimeout, ServiceConfig, SessionFile, Vehicle


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    config: ServiceConfig = None
    vehicle: Vehicle = None
    prefix: Prefix = None
    connect: Connect = None
    zenoh: SessionFile = None
    seconds: Annotated[
        float | None, typer.Option(help="For so long: exit 1 if nothing was heard.", min=0.1, show_default="for ever")
    ] = None
    timeout_s: RouterTimeout = 5.0
    as_json: Annotated[bool, typer.Option("--json", help="A JSON document a line on standard output.")] = False


def run(options: Options) -> int:
    """Show health, extrinsic and presence of every pair of a running service, as they change; gives no command."""
    from coec.cli import watch as work

    return work.run(options)
