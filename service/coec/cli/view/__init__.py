"""`coec view`: serves a vehicle or a recording to viewers with Foxglove's protocol. It never gives a command."""

from __future__ import annotations

import importlib.util
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from coec.adapters.files.rig import rig_of
from coec.adapters.foxglove.topics import Pose, frame_of, topics_for
from coec.adapters.zenoh.client import connected_by
from coec.calibration.types import Rig
from coec.cli.one_pair import pair_named
from coec.cli.query import Asked
from coec.cli.stopping import until_signal
from coec.cli.view.candidate import candidate_in
from coec.config import is_loopback, load_config
from coec.errors import UsageError
from coec.reports import console
from coec.runtime.nominal.kept import with_kept
from coec.schemas.keys import Keys
from coec.sources import open_source

if TYPE_CHECKING:
    from coec.adapters.foxglove.server import Screen

LAYOUT = "deploy/foxglove-layout.json"
ADDRESS = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[^\s:\[\]]+):(\d{1,5})")


@dataclass(frozen=True, slots=True)
class Place:
    """Where viewers are served: a host, without brackets, and a port; 0 means any free port."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class VehicleOptions:
    """Which pair of a configuration's vehicle (None: its only one), and how its service is asked; `timeout_s` is the
    wait for the router."""

    config: Path
    service: Asked
    pair: str | None
    timeout_s: float


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """What is played: `rate` times as fast as recorded, again and again if `repeat`; `result` is the file of the
    candidate, None: there is none."""

    source: str
    result: Path | None
    rate: float
    repeat: bool


def place_of(address: str, *, insecure: bool) -> Place:
    """The place that HOST:PORT names.

    Raises:
        UsageError: the text names none, or one that other computers may reach although `insecure` is not set.
    """
    found = ADDRESS.fullmatch(address)
    if found is None or int(found[2]) > 65535:
        raise UsageError(f"--listen {address}: write HOST:PORT, as 127.0.0.1:8765; port 0 is any that is free")
    host = found[1].removeprefix("[").removesuffix("]")
    if not insecure and not is_loopback(host):
        raise UsageError(
            f"--listen {address}: whoever reaches it would see what the camera sees, without a certificate: listen on "
            "loopback and forward the port (`ssh -L 8765:localhost:8765 VEHICLE`), or give --insecure"
        )
    return Place(host, int(found[2]))


def require_extra() -> None:
    """Raises UsageError, which says what to install, if the library that serves viewers is missing."""
    if importlib.util.find_spec("foxglove") is None:
        raise UsageError("coec view needs the optional extra `foxglove`: pip install 'coec[foxglove]'")


def show_vehicle(options: VehicleOptions, place: Place, *, as_json: bool) -> int:
    """Serves what the sensors and the service of a running vehicle send, until told to stop.

    Raises:
        UsageError: no such pair, or the library that serves viewers is missing.
        ConfigError: the pair's rig, or the session's configuration, cannot be used.
        ConnectionFailedError: no router answered.
        UnavailableError: the address cannot be listened on.
    """
    require_extra()
    from coec.cli.view.live import Vehicle, watch

    config = with_kept(load_config(options.config))
    pair, limits = pair_named(config, options.pair), config.limits
    rig = rig_of(pair)
    vehicle = Vehicle(Keys(options.service.prefix, options.service.vehicle), pair, rig, config)
    connection = connected_by(options.service.way, options.timeout_s, limits.max_message_bytes)
    with until_signal() as stop, connection as session:
        screen = _screen(place, rig)
        try:
            _announce(screen, rig, f"{options.service.vehicle}/{pair.name}", as_json=as_json)
            watch(session, vehicle, screen, stop)
        finally:
            screen.close()
    return 0


def show_recording(options: RecordingOptions, place: Place, *, as_json: bool) -> int:
    """Serves a recording, until told to stop.

    Raises:
        UsageError, SourceError, WindowError: no such recording or result, or the library is missing.
        UnavailableError: the address cannot be listened on.
    """
    require_extra()
    from coec.cli.view.recorded import Show, play

    recording = open_source(options.source)
    found = None if options.result is None else candidate_in(options.result)
    if found is not None and found.result.pair != recording.rig.pair:
        console.say(f"coec: the result is of pair {found.result.pair}, the recording of {recording.rig.pair}")
    refused: Counter[str] = Counter()
    with until_signal() as stop:
        screen = _screen(place, recording.rig)
        try:
            _announce(screen, recording.rig, recording.name, as_json=as_json)
            refused = play(Show(recording, found, options.rate, options.repeat), screen, stop)
        finally:
            screen.close()
    if refused:
        causes = ", ".join(f"{count} {cause}" for cause, count in sorted(refused.items()))
        console.say(f"coec: pairs that could not be shown: {causes}")
    return 0


def _screen(place: Place, rig: Rig) -> Screen:
    from coec.adapters.foxglove.server import Screen

    return Screen(place.host, place.port, f"coec {rig.pair}", rig.camera)


def _announce(screen: Screen, rig: Rig, shown: str, *, as_json: bool) -> None:
    """Prints where viewers are served, and what."""
    if as_json:
        frames = {pose.value: frame_of(rig.camera_frame, pose) for pose in Pose}
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
