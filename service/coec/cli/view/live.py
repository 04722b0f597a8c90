"""A running vehicle on the screen: its sensors while somebody looks, and what its service says."""

from __future__ import annotations

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
from coec.config import LimitsConfig, PairConfig
from coec.errors import DecodeError
from coec.runtime.ingest.decoder import CAMERA
from coec.schemas.keys import Keys

TELL_S = 1.0
"""Between two lines of the timeline, where nothing changes."""

WAIT_S = 0.05
"""For frames, between two looks at everything else."""

SERVICE = "service"
"""Where refused documents of the service are counted."""


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """Which pair of which vehicle."""

    keys: Keys
    pair: PairConfig
    rig: Rig
    limits: LimitsConfig


def watch(session: zenoh.Session, vehicle: Vehicle, screen: Screen, stop: threading.Event) -> None:
    """Show the pair until told to stop."""
    streams = Streams(session, vehicle.pair, vehicle.limits)
    service = ServiceWatch(session, vehicle.keys, vehicle.pair.name, lambda cause: streams.refused(SERVICE, cause))
    told: Moment | None = None
    told_s = float("-inf")
    try:
        with service.listening():
            while not stop.is_set():
                wanted = screen.wanted
                streams.listen(wanted=bool(wanted & PICTURES))
                pair = streams.newest(WAIT_S)
                said = service.look()
                moment = moment_of_service(vehicle.pair.name, said, streams.ages_s, streams.not_shown)
                changed = told is None or _essence(told) != _essence(moment)
                if changed or time.monotonic() - told_s >= TELL_S:
                    screen.tell(moment)
                    told, told_s = moment, time.monotonic()
                if changed:
                    screen.remark(moment.level, f"{moment.state}: {moment.why}", vehicle.pair.name)
                if pair is not None:
                    try:
                        screen.show(_picture(pair, vehicle, said, wanted))
                    except DecodeError as error:
                        streams.refused(CAMERA, error.reason)
    finally:
        streams.close()


def _picture(pair: FramePair, vehicle: Vehicle, said: Said, wanted: frozenset[str]) -> Picture:
    compensated = vehicle.pair.calibration.motion_compensation
    extrinsics = extrinsics_of_service(vehicle.rig, said)
    return picture_of(pair, vehicle.rig, extrinsics, wanted, vehicle.limits, compensated=compensated)


def _essence(moment: Moment) -> tuple[object, ...]:
    """What is worth a line in the log when it is another."""
    return moment.state, moment.reasons, moment.provenance, moment.candidate
