"""Shows a running vehicle: its sensors while somebody looks, and what its service says."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass

import zenoh

from coec.adapters.foxglove.server import Screen
from coec.adapters.foxglove.shown import Picture, picture_of
from coec.adapters.foxglove.timeline import Moment
from coec.adapters.foxglove.topics import PICTURES
from coec.calibration.types import FramePair, Rig
from coec.cli.view.moments import Said, extrinsics_of_service, moment_of_service
from coec.cli.view.service import ServiceWatch
from coec.cli.view.streams import Streams
from coec.config import Config, PairConfig
from coec.errors import DecodeError
from coec.runtime.ingest.decoder import CAMERA
from coec.schemas.keys import Keys

TELL_S = 1.0
"""Time between two lines of the timeline while nothing changes."""

WAIT_S = 0.05
"""How long to wait for frames before everything else is looked at again."""

MUTE = (
    "Nothing comes on {}: see that somebody publishes it, and that the router's rules let this session subscribe to it."
)

SERVICE = "service"
"""Name under which refused documents of the service are counted."""


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """Which pair of which vehicle."""

    keys: Keys
    pair: PairConfig
    rig: Rig
    config: Config


def watch(session: zenoh.Session, vehicle: Vehicle, screen: Screen, stop: threading.Event) -> None:
    """Shows the pair until told to stop."""
    name = vehicle.pair.name
    streams = Streams(session, vehicle.pair, vehicle.config)
    service = ServiceWatch(session, vehicle.keys, name, lambda cause: streams.refused(SERVICE, cause))
    teller = _Teller(screen, name)
    try:
        with service.listening():
            while not stop.is_set():
                wanted = screen.wanted
                streams.listen(wanted=bool(wanted & PICTURES))
                pair = streams.newest(WAIT_S)
                said = service.look()
                teller.tell(moment_of_service(name, said, streams.ages_s, streams.not_shown), streams.mute)
                if pair is not None:
                    try:
                        screen.show(_picture(pair, vehicle, said, wanted))
                    except DecodeError as error:
                        streams.refused(CAMERA, error.reason)
    finally:
        streams.close()


class _Teller:
    """Writes the timeline and the log: changes at once, and an unchanged state once a second."""

    def __init__(self, screen: Screen, pair: str) -> None:
        self._screen = screen
        self._pair = pair
        self._told: Moment | None = None
        self._told_s = -math.inf
        self._mute: tuple[str, ...] = ()

    def tell(self, moment: Moment, mute: tuple[str, ...]) -> None:
        """Tell the present state; `mute` are wanted keys on which nothing comes."""
        changed = self._told is None or _essence(self._told) != _essence(moment)
        if changed or time.monotonic() - self._told_s >= TELL_S:
            self._screen.tell(moment)
            self._told, self._told_s = moment, time.monotonic()
        if changed:
            self._screen.remark(moment.level, f"{moment.state}: {moment.why}", self._pair)
        if mute and mute != self._mute:
            self._screen.remark(1, MUTE.format(", ".join(mute)), self._pair)
        self._mute = mute


def _picture(pair: FramePair, vehicle: Vehicle, said: Said, wanted: frozenset[str]) -> Picture:
    compensated = vehicle.pair.calibration.motion_compensation
    extrinsics = extrinsics_of_service(vehicle.rig, said)
    return picture_of(pair, vehicle.rig, extrinsics, wanted, vehicle.config.limits, compensated=compensated)


def _essence(moment: Moment) -> tuple[object, ...]:
    """The part of a moment whose change is worth a line in the log."""
    return moment.state, moment.reasons, moment.provenance, moment.candidate
