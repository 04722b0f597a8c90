"""`coec view`: serves a vehicle or a recording to viewers with Foxglove's protocol. It never sends a command."""

from __future__ import annotations

import importlib.util
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli import options
from coec.errors import UsageError
from coec.reports import console
from coec.schemas.keys import Keys

if TYPE_CHECKING:
    from coec.calibration.types import Rig
    from coec.io.foxglove import ViewerServer

LAYOUT = "deploy/foxglove-layout.json"
ADDRESS = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[^\s:\[\]]+):(\d{1,5})")


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """Where viewers are served: a host, without brackets, and a port; 0 means any free port."""

    host: str
    port: int


def view(
    source: Annotated[
        str | None,
        typer.Argument(metavar="SOURCE", help=f"Recording to play: {options.SOURCE_HELP}", show_default=False),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="Instead, show the running vehicle of this configuration.", metavar="FILE"),
    ] = None,
    pair: Annotated[str | None, typer.Option(help="Pair of the configuration, if there are several.")] = None,
    connect: options.Connect = None,
    zenoh: options.SessionFile = None,
    timeout_s: options.RouterTimeout = 5.0,
    result: Annotated[
        Path | None, typer.Option(help="Output of `calibrate --json`, shown as the candidate.", metavar="FILE")
    ] = None,
    rate: Annotated[float, typer.Option(help="Factor on the recorded speed.", min=0.01, max=100)] = 1.0,
    repeat: Annotated[bool, typer.Option("--repeat", help="Repeat for ever; sensor time goes on.")] = False,
    listen: Annotated[
        str, typer.Option(help="Address for viewers; port 0 takes any free port.", metavar="HOST:PORT")
    ] = "127.0.0.1:8765",
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure",
            help="Also listen on addresses that other computers reach; they need no certificate and see everything.",
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the address and what is served as one JSON document.")
    ] = False,
) -> int:
    """Show a vehicle or a recording live in Foxglove or Lichtblick: image with points, cloud, frames, health.

    Needs the optional extra `foxglove`. Sends no command, and subscribes to frames only while there is a viewer.
    Whoever reaches the address sees everything, and so does every web page open in a browser of this computer.
    """
    address = listen_address(listen, insecure=insecure)
    if (source is None) == (config is None):
        raise UsageError("coec view: give a SOURCE, or --config FILE, and not both")
    if config is not None:
        if result is not None or repeat or rate != 1.0:
            raise UsageError("--result, --rate and --repeat are about a SOURCE: a vehicle has its own")
        service = options.service_address(config, None, None, connect, zenoh)
        _require_extra()
        return _show_vehicle(config, pair, service, timeout_s, address, as_json=as_json)
    if pair is not None or connect is not None or zenoh is not None:
        raise UsageError("--pair, --connect and --zenoh are about a vehicle: they need --config FILE")
    _require_extra()
    return _show_recording(source or "", result, rate, repeat, address, as_json=as_json)


def listen_address(text: str, *, insecure: bool) -> ListenAddress:
    """The address that HOST:PORT names.

    Raises:
        UsageError: the text names none, or one that other computers may reach although `insecure` is not set.
    """
    from coec.config import is_loopback

    match = ADDRESS.fullmatch(text)
    if match is None or int(match[2]) > 65535:
        raise UsageError(f"--listen {text}: write HOST:PORT, as 127.0.0.1:8765; port 0 is any that is free")
    host = match[1].removeprefix("[").removesuffix("]")
    if not insecure and not is_loopback(host):
        raise UsageError(
            f"--listen {text}: any host that can reach it could see the camera images without a certificate: listen on "
            "loopback and forward the port (`ssh -L 8765:localhost:8765 VEHICLE`), or give --insecure"
        )
    return ListenAddress(host, int(match[2]))


def _require_extra() -> None:
    """Raises UsageError, which says what to install, if the library that serves viewers is missing."""
    if importlib.util.find_spec("foxglove") is None:
        raise UsageError("coec view needs the optional extra `foxglove`: pip install 'coec[foxglove]'")


def _show_vehicle(
    file: Path,
    name: str | None,
    service: options.ServiceAddress,
    timeout_s: float,
    address: ListenAddress,
    *,
    as_json: bool,
) -> int:
    """Serves what the sensors and the service of a running vehicle send, until a signal.

    Raises:
        UsageError: no such pair, or the library that serves viewers is missing.
        ConfigError: the pair's rig, or the session's configuration, cannot be used.
        ConnectionFailedError: no router answered.
        UnavailableError: the address cannot be listened on.
    """
    from coec.cli.view.sources import VehiclePair, show_live
    from coec.config import load_config
    from coec.io.rig_files import rig_of
    from coec.io.zenoh.query_client import connected_by
    from coec.service.discovery import with_discovered

    config = with_discovered(load_config(file))
    pair, limits = options.pair_named(config, name), config.limits
    rig = rig_of(pair)
    vehicle = VehiclePair(Keys(service.prefix, service.vehicle), pair, rig, config)
    connection = connected_by(service.way, timeout_s, limits.max_message_bytes)
    with options.until_signal() as stop, connection as session:
        screen = _screen(address, rig)
        try:
            _announce(screen, rig, f"{service.vehicle}/{pair.name}", as_json=as_json)
            show_live(session, vehicle, screen, stop)
        finally:
            screen.close()
    return 0


def _show_recording(
    source: str, result: Path | None, rate: float, repeat: bool, address: ListenAddress, *, as_json: bool
) -> int:
    """Serves a recording, until a signal.

    Raises:
        UsageError, SourceError, WindowError: no such recording or result, or the library is missing.
        UnavailableError: the address cannot be listened on.
    """
    from coec.cli.view.sources import Playback, load_candidate, show_recording
    from coec.io.recordings.layouts import open_source

    recording = open_source(source)
    candidate = None if result is None else load_candidate(result)
    if candidate is not None and candidate.result.pair != recording.rig.pair:
        console.say(f"coec: the result is of pair {candidate.result.pair}, the recording of {recording.rig.pair}")
    refused: Counter[str] = Counter()
    with options.until_signal() as stop:
        screen = _screen(address, recording.rig)
        try:
            _announce(screen, recording.rig, recording.name, as_json=as_json)
            refused = show_recording(Playback(recording, candidate, rate, repeat), screen, stop)
        finally:
            screen.close()
    if refused:
        causes = ", ".join(f"{count} {cause}" for cause, count in sorted(refused.items()))
        console.say(f"coec: pairs that could not be shown: {causes}")
    return 0


def _screen(address: ListenAddress, rig: Rig) -> ViewerServer:
    from coec.io.foxglove import ViewerServer

    return ViewerServer(address.host, address.port, f"coec {rig.pair}", rig.camera)


def _announce(screen: ViewerServer, rig: Rig, shown: str, *, as_json: bool) -> None:
    """Prints where viewers are served, and what."""
    from coec.io.viewer_scene import DisplayedPose, frame_of, topics_for

    if as_json:
        frames = {pose.value: frame_of(rig.camera_frame, pose) for pose in DisplayedPose}
        console.print_json(
            {
                "url": screen.url,
                "shown": shown,
                "topics": dict(topics_for(rig.camera)),
                "frames": {"lidar": rig.lidar_frame, **frames},
            }
        )
        return
    console.show(f"{screen.url}  {shown}")
    console.show(f"Open it in Foxglove or Lichtblick, with the layout {LAYOUT}; Ctrl-C ends it.")
