"""What `coec view` takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import SOURCE_HELP, Connect, RouterTimeout, SessionFile
from coec.errors import UsageError


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: Annotated[
        str | None, typer.Argument(metavar="SOURCE", help=f"Recording to play: {SOURCE_HELP}", show_default=False)
    ] = None
    config: Annotated[
        Path | None,
        typer.Option(help="Instead, show the running vehicle of this configuration.", metavar="FILE"),
    ] = None
    pair: Annotated[str | None, typer.Option(help="Pair of the configuration, if there are several.")] = None
    connect: Connect = None
    zenoh: SessionFile = None
    timeout_s: RouterTimeout = 5.0
    result: Annotated[
        Path | None, typer.Option(help="Output of `calibrate --json`, drawn as the candidate.", metavar="FILE")
    ] = None
    rate: Annotated[float, typer.Option(help="Factor on the recorded speed.", min=0.01, max=100)] = 1.0
    repeat: Annotated[bool, typer.Option("--repeat", help="Repeat for ever; sensor time goes on.")] = False
    listen: Annotated[
        str, typer.Option(help="Address for viewers; port 0 takes any free port.", metavar="HOST:PORT")
    ] = "127.0.0.1:8765"
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure", help="Also listen where other computers get in; they need no certificate and see everything."
        ),
    ] = False
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the address and what is served as one JSON document.")
    ] = False


def run(options: Options) -> int:
    """Show a vehicle or a recording live in Foxglove or Lichtblick: image with points, cloud, frames, health.

    Needs the optional extra `foxglove`. Gives no command, and asks the vehicle for frames only while somebody looks.
    Whoever reaches the address sees everything, and so does every web page open in a browser of this computer.
    """
    from coec.cli import query
    from coec.cli import view as work

    place = work.place_of(options.listen, insecure=options.insecure)
    if (options.source is None) == (options.config is None):
        raise UsageError("coec view: give a SOURCE, or --config FILE, and not both")
    if options.config is not None:
        if options.result is not None or options.repeat or options.rate != 1.0:
            raise UsageError("--result, --rate and --repeat are about a SOURCE: a vehicle has its own")
        service = query.asked_of(options.config, None, None, options.connect, options.zenoh)
        watched = work.VehicleOptions(options.config, service, options.pair, options.timeout_s)
        return work.show_vehicle(watched, place, as_json=options.as_json)
    if options.pair is not None or options.connect is not None or options.zenoh is not None:
        raise UsageError("--pair, --connect and --zenoh are about a vehicle: they need --config FILE")
    played = work.RecordingOptions(options.source or "", options.result, options.rate, options.repeat)
    return work.show_recording(played, place, as_json=options.as_json)
