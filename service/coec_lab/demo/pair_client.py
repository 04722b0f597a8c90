"""The demonstration with one camera. The drive: scenario, configuration of the service, and the vehicle that renders
ahead in other processes and publishes at the pace of the service. The client of the service: what it receives, compared
with the truth that only the vehicle knows, and the outcome: correct before the displacement, an alarm after it, then
corrected."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import zenoh

from coec import config
from coec.calibration.types import Frame, Matrix4, Rig
from coec.errors import NotFoundError, RemoteError
from coec.geometry import se3
from coec.io.recordings import window_cutting
from coec.io.rig_files import intrinsics_config, matrix_rows
from coec.io.zenoh.player import CAMERA, Played, Player, StreamKeys
from coec.io.zenoh.query_client import query_all
from coec.schemas import replies
from coec.schemas.keys import Keys
from coec.schemas.message import from_json
from coec_lab.demo.service import MIN_FREE_BYTES, QUERY_S, STORY_CORES, query_json
from coec_lab.simulation.source import require_embree

if TYPE_CHECKING:
    from coec_lab.simulation.drive import DriveConfig, SimulatedDrive


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


SEED = 1
LONGEST_S = 240.0
"""Longest drive; it ends as soon as the mount is corrected."""

WORKSHOP = (0.6, -0.5, 0.4, 0.0, 0.0, 0.0)
"""Error of the workshop's calibration: degrees in pitch, yaw, roll, and metres."""

KNOCK_S, KNOCK_DEG = 36.0, 3.0
"""When and by how much the mount is displaced, in pitch: after the first window has been judged."""

TITLE = f"A mount that is displaced by {KNOCK_DEG:g}° while the vehicle drives"
REPORT = "report.html"
"""File of the page, which exists from the first picture on."""

REST_S = 12.0
"""Driving after the correction: two more checks of the monitor."""

CLOSE_UP_PX = (170, 285, 400, 170)
"""Left, top, width and height of the part of the picture that shows cars and kerbs."""

PAIR_HZ, EGO_HZ = 1.0, 50.0
"""Frames per second of driving: only as many pairs are rendered as the service would select."""

WINDOW = config.WindowConfig(pairs=12, min_pairs=8, slice_s=24.0)
MONITOR = config.MonitorConfig(period_s=5.0, pairs=5, min_pairs=4, urgent_slice_s=12.0)
"""Shorter than on a vehicle, where a window takes three minutes, which is too long to watch."""

MAX_ERROR_DEG = 0.25
"""Largest error of a correction (geodesic angle)."""

RATE = 4.0
"""Most seconds of driving in a second; each half second, two pictures with their sweeps must be rendered."""

POLL_S = 0.05

RENDERERS = 2
"""Processes that render, each with its own street in memory."""

NS_PER_S = 1_000_000_000

LEAD_NS = 7 * NS_PER_S
"""The drive waits while it is so far ahead of what the service has judged: one check of the monitor, and a little."""

STEP_NS = 2 * NS_PER_S
"""A service that is idle although it has everything (no checks follow soon after a window) gets so much more."""

ON_THE_WAY = 1
"""Pictures that may still be in transit, or lost without a trace, when the service counts as having them all."""


def drive_config() -> DriveConfig:
    """A vehicle with a 185° fisheye of 700×700 pixels and a LiDAR of 64 beams, and the knock.

    Raises:
        SourceError: the library that casts rays is not installed.
    """
    require_embree()
    from coec_lab.simulation.drive import DriveConfig
    from coec_lab.simulation.faults import StepFault

    return DriveConfig(
        seed=SEED,
        seconds=LONGEST_S,
        camera="fisheye700",
        lidar="64",
        camera_hz=PAIR_HZ,
        lidar_hz=PAIR_HZ,
        ego_hz=EGO_HZ,
        faults=(StepFault(KNOCK_S, LONGEST_S, rx=KNOCK_DEG),),
        workshop=WORKSHOP,
    )


def service_config(rig: Rig, mask: Path, endpoint: str) -> config.Config:
    """Configuration of the service: defaults, except for rig, address, and what is shorter than on a vehicle."""
    streams = StreamKeys.default(rig.pair)
    pair = config.PairConfig(
        name=rig.pair,
        camera=config.CameraConfig(
            key=streams.camera,
            frame_id=rig.camera_frame,
            intrinsics=intrinsics_config(rig.camera),
            mask=mask,
        ),
        lidar=config.LidarConfig(key=streams.lidar, frame_id=rig.lidar_frame),
        ego=config.EgoConfig(key=str(streams.ego), T_lidar_ego=matrix_rows(rig.T_lidar_ego)),
        T_camera_lidar=matrix_rows(rig.T_camera_lidar_nominal),
        window=WINDOW,
        monitor=MONITOR,
    )
    return config.Config(
        budget=config.BudgetConfig(cores=STORY_CORES),
        zenoh=config.ZenohConfig(connect=(endpoint,), listen=(endpoint,)),
        state=config.StateConfig(directory=Path("state"), min_free_bytes=MIN_FREE_BYTES),
        # The solver competes with rendering here; on a vehicle cameras take no processor time.
        worker=config.WorkerConfig(niceness=0),
        pairs=(pair,),
    )


@dataclass(slots=True)
class Pace:
    """How far the drive may go.

    Attributes:
        judged_ns: sensor time up to which the service has judged, or has nothing left to judge.
    """

    judged_ns: int

    def update(self, judged_ns: int | None, *, at_rest: bool, stamp_ns: int) -> None:
        """Takes a report of the service into account.

        Args:
            judged_ns: sensor time up to which it has judged; None: nothing yet.
            at_rest: whether it is idle although it has everything that was sent.
            stamp_ns: sensor time up to which the drive had been sent when the service was queried.
        """
        self.judged_ns = max(self.judged_ns, judged_ns or 0)
        if at_rest:
            self.judged_ns = max(self.judged_ns, stamp_ns + STEP_NS - LEAD_NS)

    def may_pass(self, stamp_ns: int) -> bool:
        """Whether the drive may go on to this sensor time."""
        return stamp_ns <= self.judged_ns + LEAD_NS


def at_rest(worker: replies.WorkerStatus, pair: replies.PairStatus, sent: int) -> bool:
    """Whether the service has received `sent` pictures and is idle.

    Its report of worker and pairs is of one instant, and is renewed every second.
    """
    arrived = pair.camera.received + sum(pair.camera.losses.values())
    idle = worker.state == "idle" and not worker.queued and not pair.held and not pair.unanswered
    return idle and arrived + ON_THE_WAY >= sent


class PairVehicle:
    """Drives in a thread of its own.

    Attributes:
        stamp_ns: sensor time of the latest published frame; before that, of the first picture.
        played: how many frames of each stream were published.
        failure: why the thread ended early; None if it did not.
    """

    def __init__(self, session: zenoh.Session, drive: SimulatedDrive, may_pass: Callable[[int], bool]) -> None:
        """`may_pass`: whether the drive may go on to a sensor time."""
        self._drive = drive
        self._may_pass = may_pass
        self._player = Player(session, StreamKeys.default(drive.rig.pair), "msgpack")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicle")
        self.stamp_ns = drive.camera_stamps_ns[0]
        self.played: Played = self._player.played
        self.failure: Exception | None = None

    @property
    def arrived(self) -> bool:
        """Whether the drive is over."""
        return not self._thread.is_alive()

    @property
    def second(self) -> float:
        """The present second of the drive."""
        return max((self.stamp_ns - self._drive.camera_stamps_ns[0]) / NS_PER_S, 0.0)

    @property
    def pictures(self) -> int:
        """How many pictures have been sent."""
        return self.played.frames[CAMERA]

    def start(self, wait_s: float) -> list[str]:
        """Starts the drive once the service subscribes; returns the keys without a subscriber after `wait_s`."""
        without_listener = self._player.wait_for_listener(wait_s)
        if not without_listener:
            self._thread.start()
        return without_listener

    def stop(self) -> None:
        """Ends the drive."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._player.close()

    def _run(self) -> None:
        from coec_lab.simulation.parallel import messages_by

        try:
            frames = messages_by(self._drive.config, min(os.cpu_count() or 1, RENDERERS))
            self._player.play(paced(frames, self._may_pass, self._stop), 0.0, self._stop, self._on_sent)
        except Exception as error:  # reported by the thread that watches
            self.failure = error

    def _on_sent(self, frame: Frame, _: Played) -> None:
        self.stamp_ns = frame.stamp_ns


def paced(
    frames: Iterable[Frame], may_pass: Callable[[int], bool], stop: threading.Event, rate: float = RATE
) -> Iterator[Frame]:
    """Yields each frame when it is due after the one before and the service has kept up.

    Args:
        may_pass: whether the drive may go on to a sensor time.
        stop: ends all waiting.
        rate: most seconds of driving in a second.
    """
    before_ns, before_s = None, 0.0
    for frame in frames:
        if before_ns is not None:
            stop.wait(max(before_s + (frame.stamp_ns - before_ns) / NS_PER_S / rate - time.monotonic(), 0.0))
        while not may_pass(frame.stamp_ns) and not stop.wait(POLL_S):
            pass
        before_ns, before_s = frame.stamp_ns, time.monotonic()
        yield frame
