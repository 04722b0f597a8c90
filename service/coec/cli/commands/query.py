"""What `coec query` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli import completing
from coec.cli.options import Connect, Json, Prefix, ServiceConfig, Vehicle


@dataclass(frozen=True, slots=True)
class Key:
    """What can be asked for. `parameters` are those of `--param`, beside `format`."""

    key: str
    answer: str
    parameters: str = ""


KEYS = (
    Key("extrinsic", "where the camera is, with sigma", "format=tf, urdf, ... as `coec export`; parent, child"),
    Key("health", "state, reasons, figures and their limits"),
    Key("history", "past results, and who changed what", "since=NS, until=NS, limit=COUNT"),
    Key("windows", "recorded windows and snippets"),
    Key("windows/ID", "one of them, into --output FILE, its sha256 verified"),
    Key("overlay", "picture of the latest window, into --output FILE.jpg", "at=nominal, window=ID"),
    Key("evidence", "red events that are kept"),
    Key("evidence/ID", "one of them; a picture of it with --output FILE.jpg", "overlay=before, overlay=after"),
    Key("rig", "all sensors of the vehicle together"),
    Key("status", "the service itself: streams, worker, budget, troubles"),
    Key("config", "its effective configuration, without secrets"),
    Key("metrics", "OpenMetrics text"),
    Key("command/NAME", "calibrate, apply, rollback, reset, commission, hold", "timeout_ms=COUNT"),
)
"""In the order of the help text."""


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    key: Annotated[
        str,
        typer.Argument(
            help="One of the keys above, or a whole key expression with @v1 in it.",
            metavar="KEY",
            autocompletion=completing.query_keys,
            show_default=False,
        ),
    ]
    pair: Annotated[
        str | None, typer.Option(help="Pair to ask; default: all. A command needs it if there are several pairs.")
    ] = None
    config: ServiceConfig = None
    vehicle: Vehicle = None
    prefix: Prefix = None
    connect: Connect = None
    zenoh: Annotated[
        Path | None,
        typer.Option(
            help="Zenoh configuration (JSON5) to connect with; its certificate proves commands.",
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
    to: Annotated[
        str | None,
        typer.Option(
            help="For command/rollback: window or sha256 from `query history` to serve again.", metavar="HASH"
        ),
    ] = None
    candidate: Annotated[
        str | None,
        typer.Option(
            help="For command/apply: window or sha256 of the candidate from `query extrinsic`; another one is refused.",
            metavar="HASH",
        ),
    ] = None
    release: Annotated[bool, typer.Option("--release", help="For command/hold: end the hold.")] = False
    reason: Annotated[
        str | None,
        typer.Option(
            help="For any command: the reason. It appears in `query history`, and for a hold also in extrinsic and "
            "health.",
            metavar="TEXT",
        ),
    ] = None
    sensor: Annotated[
        str | None,
        typer.Option(help="For any command: apply it to all pairs of this sensor of the rig.", metavar="NAME"),
    ] = None
    payload: Annotated[
        str | None, typer.Option(help="Payload of a command as JSON, instead of these options.", metavar="JSON")
    ] = None
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Seconds to wait for the router and for the answer.", min=0.01)
    ] = 5.0
    output: Annotated[
        Path | None,
        typer.Option(
            help="File to write, byte for byte as it was sent: windows/ID with its sha256 verified, overlay, or a "
            "picture of evidence/ID.",
            metavar="FILE",
        ),
    ] = None
    force: Annotated[
        bool, typer.Option("--force", help="Replace a FILE that holds something else than the window.")
    ] = False
    as_json: Json = False


def run(options: Options) -> int:
    from coec.cli import query as work

    return work.run(options)


def _help() -> str:
    """Every key, what it answers and its parameters, kept in columns by the mark that help texts know."""
    width = max(len(each.key) for each in KEYS)
    rows = []
    for each in KEYS:
        rows.append(f"{each.key:{width}}  {each.answer}")
        if each.parameters:
            rows.append(f"{'':{width}}    --param {each.parameters}")
    listed = "\n".join(rows)
    several = (
        "With --json, several pairs give one document: {pairs: {NAME: answer of the pair}}; one pair, or --pair, gives "
        "its answer alone."
    )
    return f"Ask a running service.\n\n\b\n{listed}\n\n{several}"


run.__doc__ = _help()
