"""What `coec play` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from coec.cli.options import Connect, Json, Source

Middleware = Literal["native", "rmw_zenoh", "ros2dds"]
"""How a recording speaks on the bus."""

Encoding = Literal["msgpack", "cdr"]
"""Of frames."""


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: Source
    config: Annotated[Path | None, typer.Option(help="Take the keys of the pair from this file.", metavar="FILE")] = (
        None
    )
    pair: Annotated[
        str | None,
        typer.Option(
            help="Pair of the configuration; without --config, the name in `sensors/<pair>/camera|lidar|ego`."
        ),
    ] = None
    middleware: Annotated[
        Middleware | None,
        typer.Option(
            help="native: frames on the keys of a pair. rmw_zenoh, ros2dds: a bag on its own topics, byte for byte; "
            "any other recording on those of the configuration's pair, or below `/<pair>/`.",
            show_default="that of --config, else native",
        ),
    ] = None
    topics: Annotated[
        list[str] | None,
        typer.Option(
            "--topics", help="Play only these ROS 2 topics; separated by commas, or repeatable.", show_default="all"
        ),
    ] = None
    domain: Annotated[
        int | None,
        typer.Option(help="ROS_DOMAIN_ID (rmw_zenoh).", min=0, max=232, show_default="that of --config, else 0"),
    ] = None
    rate: Annotated[float, typer.Option(help="Factor on the recorded speed; 0 = without waiting.", min=0)] = 1.0
    loop: Annotated[bool, typer.Option("--loop", help="Repeat for ever; sensor time goes on.")] = False
    connect: Connect = None
    encoding: Annotated[Encoding, typer.Option(help="Encoding of the frames.")] = "msgpack"
    start_now: Annotated[bool, typer.Option("--start-now", help="Shift all stamps so that the first is now.")] = False
    as_json: Json = False


def run(options: Options) -> int:
    """Publish a recording on Zenoh, as its sensors would have."""
    from coec.cli import play as work

    return work.run(options)
