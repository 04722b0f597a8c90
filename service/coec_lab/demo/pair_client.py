"""A client of the service during the demonstration: what it receives, compared with the truth that only the vehicle
knows, and the outcome: correct before the displacement, an alarm after it, then corrected."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import zenoh

from coec.calibration.types import Matrix4
from coec.errors import NotFoundError, RemoteError
from coec.geometry import se3
from coec.io.recordings import window_cutting
from coec.io.zenoh.query_client import query_all
from coec.schemas import replies
from coec.schemas.keys import Keys
from coec.schemas.message import from_json
from coec_lab.demo.pair_drive import NS_PER_S, Pace, at_rest
from coec_lab.demo.service import QUERY_S, query_json

ALARM: Final = "miscalibrated"


@dataclass(frozen=True, slots=True)
class Moment:
    """State that the service reported at one instant. `drive_s` counts seconds of driving. Errors, in degrees, are
    those of the served extrinsic, which comes from the window `window_id`, against the truth at that time."""

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
class Snapshot:
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
class Observer:
    """Queries the service again and again, and records what changed.

    Attributes:
        truth: true T_camera_lidar (4, 4) at a second of the drive.
        first_ns: sensor time at which the drive begins.
        pace: how far the drive may go on.
        series: every snapshot: (second of the drive, error in degrees, health).
        timeline: the moments at which something changed.
        alarms: number of the service's alarms that are in the timeline.
        latest: the last snapshot; None before the first answer.
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
    latest: Snapshot | None = None

    def may_pass(self, stamp_ns: int) -> bool:
        """Whether the drive may go on to this sensor time."""
        return self.latest is not None and self.pace.may_pass(stamp_ns)

    def poll(self, drive_s: float, sent: int) -> Snapshot | None:
        """The state after so many seconds of driving and `sent` pictures, or None while the service is not there
        yet."""
        if not query_all(self.session, self.keys.status, QUERY_S):
            return None
        try:
            snapshot = self._query_all(drive_s)
        except (NotFoundError, RemoteError):
            return None
        self.latest = snapshot
        rests = at_rest(snapshot.status.worker, snapshot.pair, sent)
        self.pace.update(
            snapshot.health.evaluated_ns, at_rest=rests, stamp_ns=self.first_ns + round(drive_s * NS_PER_S)
        )
        self._catch_up(snapshot)
        self.series.append((drive_s, snapshot.moment.error_deg, snapshot.moment.health))
        if not self.timeline or _essence(snapshot.moment) != _essence(self.timeline[-1]):
            self.timeline.append(snapshot.moment)
        return snapshot

    def events(self) -> tuple[replies.EvidenceEvent, ...]:
        """Incidents that the service has recorded."""
        return from_json(replies.EvidenceReply, query_json(self.session, self.keys.evidence(self.pair))).events

    def _catch_up(self, snapshot: Snapshot) -> None:
        """Adds alarms that began and ended between two polls, as on a busy machine; the service records them as
        events."""
        counts = snapshot.health.alarms
        raised = 0 if counts is None else counts.confirmed + counts.withdrawn + counts.open
        if raised <= self.alarms:
            return
        if snapshot.health.state == ALARM:
            self.alarms = raised
            return
        events = self.events()
        for event in events[self.alarms :]:
            second = (event.stamp_ns - self.first_ns) / NS_PER_S
            self.timeline = with_alarm(self.timeline, second)
            served = next((error for at, error, _ in reversed(self.series) if at <= second), snapshot.moment.error_deg)
            self.series = sorted([*self.series, (second, served, ALARM)], key=lambda point: point[0])
        self.alarms = max(self.alarms, len(events))

    def _query_all(self, drive_s: float) -> Snapshot:
        status = from_json(replies.StatusReply, query_json(self.session, self.keys.status))
        health = from_json(replies.HealthReply, query_json(self.session, self.keys.health(self.pair)))
        extrinsic = from_json(replies.ExtrinsicReply, query_json(self.session, self.keys.extrinsic(self.pair)))
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
            error_deg=window_cutting.rotation_error_deg(served, truth),
        )
        return Snapshot(moment, status, health, extrinsic)


def with_alarm(timeline: Sequence[Moment], drive_s: float) -> list[Moment]:
    """A timeline with a missed alarm added at a second of the drive, with the extrinsic that was served before it."""
    before = [moment for moment in timeline if moment.drive_s <= drive_s]
    alarm = [replace(moment, drive_s=round(drive_s, 2), health=ALARM) for moment in before[-1:]]
    return [*before, *alarm, *timeline[len(before) :]]


def _degrees(T_one: Matrix4, T_other: Matrix4) -> tuple[float, float, float]:
    rx, ry, rz = (float(angle) for angle in np.degrees(se3.difference(T_one, T_other)[:3]))
    return rx, ry, rz


def _essence(moment: Moment) -> tuple[object, ...]:
    """Fields whose change makes a new line of the timeline."""
    return moment.service, moment.health, moment.provenance, moment.status, moment.error_deg


@dataclass(frozen=True, slots=True)
class PairOutcome:
    """The outcome of the drive, in seconds of driving; None for what did not happen.

    Attributes:
        false_alarm_s: the first alarm before the knock while the extrinsic was right.
        alarm_s: the first alarm after the knock.
        repaired_s: when, after the alarm, the service had an estimate of its own within the limit and was healthy.
        error_before_deg: largest error of the served extrinsic after the displacement, that before the correction.
        error_after_deg: error at the end.
    """

    knock_s: float
    false_alarm_s: float | None
    alarm_s: float | None
    repaired_s: float | None
    error_before_deg: float
    error_after_deg: float
    health: str

    @property
    def passed(self) -> bool:
        """Whether all of it happened, and the service is healthy at the end."""
        return not self.failures()

    def failures(self) -> tuple[str, ...]:
        """What did not happen, one sentence each."""
        sentences = []
        if self.false_alarm_s is not None:
            sentences.append(f"The service raised an alarm at {self.false_alarm_s:.0f} s, before the displacement.")
        if self.alarm_s is None:
            sentences.append("The service never detected the displacement.")
        elif self.repaired_s is None:
            sentences.append("The service detected the displacement, and did not correct it.")
        elif self.health != "healthy":
            sentences.append(f"The service corrected the displacement, and is {self.health} at the end.")
        return tuple(sentences)


def outcome_of(timeline: Sequence[Moment], knock_s: float, max_error_deg: float) -> PairOutcome:
    """The outcome of a timeline that is not empty.

    Args:
        timeline: ascending in time.
        knock_s: second of the drive at which the mount was displaced.
        max_error_deg: an estimate counts as a correction only if it is nearer to the truth than this, also at the end.
    """
    # An alarm about the workshop's calibration, which is served first and is wrong, is no false alarm.
    false = (m for m in timeline if m.health == ALARM and m.drive_s < knock_s and m.error_deg < max_error_deg)
    late = [moment for moment in timeline if moment.drive_s >= knock_s]
    alarm_s = next((moment.drive_s for moment in late if moment.health == ALARM), None)
    last = timeline[-1]
    repaired = (
        moment.drive_s
        for moment in late
        if alarm_s is not None and moment.drive_s >= alarm_s and is_repaired(moment, max_error_deg)
    )
    return PairOutcome(
        knock_s=knock_s,
        false_alarm_s=next((moment.drive_s for moment in false), None),
        alarm_s=alarm_s,
        repaired_s=next(repaired, None) if last.error_deg < max_error_deg else None,
        error_before_deg=max((moment.error_deg for moment in late), default=last.error_deg),
        error_after_deg=last.error_deg,
        health=last.health,
    )


def is_repaired(moment: Moment, max_error_deg: float) -> bool:
    """Whether the service is healthy and serves an estimate of its own within the limit of the truth."""
    return moment.health == "healthy" and moment.provenance == "estimated" and moment.error_deg < max_error_deg
