"""What a client of the service sees during the demonstration, compared with the truth that only the vehicle knows."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import zenoh

from coec.adapters.zenoh.client import ask, ask_one
from coec.calibration.types import Matrix4
from coec.errors import NotFoundError, RemoteError
from coec.geometry import se3
from coec.schemas import replies
from coec.schemas.base import from_json
from coec.schemas.keys import Keys
from coec.sources import windows
from coec_lab.demo.pace import NS_PER_S, Pace, at_rest

ALARM: Final = "miscalibrated"

ASK_S = 10.0
"""Timeout of one answer, on a machine that also draws the street."""


@dataclass(frozen=True, slots=True)
class Moment:
    """What the service said at one instant. `drive_s` counts seconds of driving. Errors, in degrees, are those of the
    served extrinsic, which comes from the window `window_id`, against the truth at that time."""

    t_s: float
    drive_s: float
    service: str
    health: str
    provenance: str
    status: str
    window_id: str | None
    correction_deg: tuple[float, float, float]
    error_by_axis_deg: tuple[float, float, float]
    error_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """All answers of one instant."""

    moment: Moment
    status: replies.StatusReply
    health: replies.HealthReply
    extrinsic: replies.ExtrinsicReply

    @property
    def pair(self) -> replies.PairStatus:
        """Counters of the pair."""
        return self.status.pairs[0]

    @property
    def T_camera_lidar(self) -> Matrix4:
        """(4, 4) the served extrinsic."""
        return np.array(self.extrinsic.camera_from_lidar.matrix)


@dataclass(slots=True)
class Watch:
    """Asks the service again and again, and keeps what changed.

    Attributes:
        truth: true T_camera_lidar (4, 4) at a second of the drive.
        first_ns: sensor time at which the drive begins.
        pace: how far the drive may go on.
        series: everything seen: (second of the drive, error in degrees, health).
        timeline: the moments at which something changed.
        alarms: number of the service's alarms that are in the timeline.
        latest: what was seen last; None before the first answer.
    """

    session: zenoh.Session
    keys: Keys
    pair: str
    nominal: Matrix4
    truth: Callable[[float], Matrix4]
    first_ns: int
    pace: Pace
    started_s: float
    series: list[tuple[float, float, str]] = field(default_factory=list)
    timeline: list[Moment] = field(default_factory=list)
    alarms: int = 0
    latest: Seen | None = None

    def may_pass(self, stamp_ns: int) -> bool:
        """Whether the drive may go on to this sensor time."""
        return self.latest is not None and self.pace.may_pass(stamp_ns)

    def look(self, drive_s: float, sent: int) -> Seen | None:
        """The state after so many seconds of driving and `sent` pictures, or None while the service is not there
        yet."""
        if not ask(self.session, self.keys.status, ASK_S):
            return None
        try:
            seen = self._ask_all(drive_s)
        except (NotFoundError, RemoteError):
            return None
        self.latest = seen
        rests = at_rest(seen.status.worker, seen.pair, sent)
        self.pace.saw(seen.health.evaluated_ns, at_rest=rests, stamp_ns=self.first_ns + round(drive_s * NS_PER_S))
        self._catch_up(seen)
        self.series.append((drive_s, seen.moment.error_deg, seen.moment.health))
        if not self.timeline or _essence(seen.moment) != _essence(self.timeline[-1]):
            self.timeline.append(seen.moment)
        return seen

    def events(self) -> tuple[replies.EvidenceEvent, ...]:
        """Red events that the service has kept."""
        return from_json(replies.EvidenceReply, self._ask(self.keys.evidence(self.pair))).events

    def _catch_up(self, seen: Seen) -> None:
        """Adds alarms that came and went between two looks, as on a busy machine; the service keeps them as events."""
        told = seen.health.alarms
        raised = 0 if told is None else told.confirmed + told.withdrawn + told.open
        if raised <= self.alarms:
            return
        if seen.health.state == ALARM:
            self.alarms = raised
            return
        events = self.events()
        for event in events[self.alarms :]:
            second = (event.stamp_ns - self.first_ns) / NS_PER_S
            self.timeline = with_alarm(self.timeline, second)
            served = next((error for at, error, _ in reversed(self.series) if at <= second), seen.moment.error_deg)
            self.series = sorted([*self.series, (second, served, ALARM)], key=lambda point: point[0])
        self.alarms = max(self.alarms, len(events))

    def _ask_all(self, drive_s: float) -> Seen:
        status = from_json(replies.StatusReply, self._ask(self.keys.status))
        health = from_json(replies.HealthReply, self._ask(self.keys.health(self.pair)))
        extrinsic = from_json(replies.ExtrinsicReply, self._ask(self.keys.extrinsic(self.pair)))
        served = np.array(extrinsic.camera_from_lidar.matrix)
        truth = self.truth(drive_s)
        moment = Moment(
            t_s=round(time.monotonic() - self.started_s, 2),
            drive_s=round(drive_s, 2),
            service=status.state,
            health=health.state,
            provenance=extrinsic.provenance,
            status=extrinsic.status,
            window_id=extrinsic.window_id,
            correction_deg=_degrees(served, self.nominal),
            error_by_axis_deg=_degrees(served, truth),
            error_deg=windows.rotation_error_deg(served, truth),
        )
        return Seen(moment, status, health, extrinsic)

    def _ask(self, key: str) -> bytes:
        return ask_one(self.session, f"{key}?format=json", ASK_S).payload


def with_alarm(timeline: Sequence[Moment], drive_s: float) -> list[Moment]:
    """A timeline with a missed alarm added at a second of the drive, with the extrinsic that was served before it."""
    before = [moment for moment in timeline if moment.drive_s <= drive_s]
    alarm = [replace(moment, drive_s=round(drive_s, 2), health=ALARM) for moment in before[-1:]]
    return [*before, *alarm, *timeline[len(before) :]]


def _degrees(T_one: Matrix4, T_other: Matrix4) -> tuple[float, float, float]:
    rx, ry, rz = (float(angle) for angle in np.degrees(se3.difference(T_one, T_other)[:3]))
    return rx, ry, rz


def _essence(moment: Moment) -> tuple[object, ...]:
    """What must change to make a new line of the timeline."""
    return moment.service, moment.health, moment.provenance, moment.status, moment.error_deg
