"""The last step of the demonstration of a rig: sends frames, and gets what the service believes about every sensor."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import hypot

from coec.adapters.zenoh.player import Player
from coec.reports.rig_plot import MOVED, EdgeSeen
from coec.schemas.replies import CheckReply
from coec.schemas.rig_state import RigReply, SensorReply
from coec.simulation.journey import START_NS
from coec_lab.demo.daemon import DemoError
from coec_lab.demo.rig.service import Service
from coec_lab.demo.rig.vehicle import Frames

NS_PER_S = 1_000_000_000

LISTEN_S = 30.0
"""Time limit for a running service to listen to all its sensors."""

MOST_HELD = 4
"""Frame pairs that may wait in the service when more are sent, so that it has work while these are drawn."""


@dataclass(frozen=True, slots=True)
class SensorTold:
    """What the service believes about a sensor, see `SensorReply`; `moved_deg` is None if it did not move."""

    name: str
    kind: str
    state: str
    probability: float
    moved_deg: float | None
    reason: str


@dataclass(frozen=True, slots=True)
class Told:
    """What the service believes after looks at some pairs.

    Attributes:
        second: of the drive, up to which everything is included.
        looked_at: the pairs.
        sensors: by name.
        edges: what the latest look at each pair says, by pair, without pairs that were never looked at.
    """

    second: float
    looked_at: str
    sensors: Mapping[str, SensorTold]
    edges: Mapping[str, EdgeSeen]

    @property
    def named(self) -> frozenset[str]:
        """Sensors that are said to have moved."""
        return frozenset(name for name, sensor in self.sensors.items() if sensor.state in MOVED)


class Asker:
    """Sends frames to a service, and asks it."""

    def __init__(self, service: Service) -> None:
        """Raises DemoError: the service does not listen to its sensors."""
        self._service = service
        self._player = Player(service.session, service.sensors, "msgpack")
        if deaf := self._player.wait_for_listener(LISTEN_S):
            raise DemoError(f"the service does not listen to {', '.join(deaf)}")
        self._instants = 0
        self._motion_ns = -1
        self._looks: Mapping[str, int] = {}

    def hear(self, frames: Frames) -> list[Told]:
        """Sends the frames of one more instant; returns what is new since the last call.

        Raises:
            DemoError: the service ends, or does not look.
        """
        # Two instants may share motion.
        motions = [motion for motion in frames.motions if motion.stamp_ns > self._motion_ns]
        self._motion_ns = max((motion.stamp_ns for motion in motions), default=self._motion_ns)
        ordered = sorted((frames.sweep, *frames.pictures.values(), *motions), key=lambda frame: frame.stamp_ns)
        self._player.play(ordered, 0.0, threading.Event(), lambda *_: None)
        self._instants += 1
        self._service.until_taken(self._instants, MOST_HELD)
        return self._new()

    def rest(self) -> list[Told]:
        """After the last frames, waits until all were looked at; returns what is new.

        Raises:
            DemoError: the service ends, or does not look.
        """
        self._service.until_at_rest()
        return self._new()

    def _new(self) -> list[Told]:
        reply = self._service.rig()
        looked_at = sorted(pair for pair, count in reply.looks.items() if count > self._looks.get(pair, 0))
        if not looked_at or reply.stamp_ns is None:
            return []
        self._looks = reply.looks
        health = self._service.health()
        checks = {pair: of.check for pair, of in health.items() if of.check is not None}
        return [told_of(reply, reply.stamp_ns, looked_at, checks, self._service.sensors_of)]


def told_of(
    reply: RigReply,
    stamp_ns: int,
    looked_at: Sequence[str],
    checks: Mapping[str, CheckReply],
    sensors_of: Mapping[str, tuple[str, str]],
) -> Told:
    """What a reply about everything up to a stamp, and the latest checks, say. `sensors_of` names camera and LiDAR of
    each pair."""
    return Told(
        second=(stamp_ns - START_NS) / NS_PER_S,
        looked_at=", ".join(looked_at),
        sensors={one.name: _sensor(one) for one in reply.sensors},
        edges={pair: _edge(*sensors_of[pair], check) for pair, check in checks.items()},
    )


def _sensor(of: SensorReply) -> SensorTold:
    moved_deg = None if of.moved is None else hypot(*of.moved.by[:3])
    return SensorTold(of.name, of.kind, of.state, of.probability or 0.0, moved_deg, of.reasons[0].text)


def _edge(camera: str, lidar: str, told: CheckReply) -> EdgeSeen:
    """How much the pair is turned. Its σ is chosen so that the turn is as many σ as all three axes together."""
    pairs = zip(told.offset[:3], told.sigma[:3], strict=True)
    axes = [(turn, sigma) for turn, sigma in pairs if turn is not None and sigma is not None and sigma > 0.0]
    turn_deg, sigmas = hypot(*(turn for turn, _ in axes)), hypot(*(turn / sigma for turn, sigma in axes))
    return EdgeSeen(camera, lidar, turn_deg, turn_deg / sigmas if sigmas > 0.0 else float("nan"))
