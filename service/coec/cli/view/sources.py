"""What `coec view` shows to viewers: a recording, played at its own rate, or what the sensors and the service of a
running vehicle send.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import zenoh

from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import NS_PER_S, FramePair, Matrix4, Rig
from coec.config import Config, LimitsConfig, PairConfig, PairingConfig
from coec.errors import DecodeError, SourceError
from coec.geometry import se3
from coec.io import viewer_scene
from coec.io.foxglove import ViewerServer
from coec.io.logs import LossCounter
from coec.io.recordings.layouts import RecordingSource
from coec.io.recordings.window_cutting import RECORDED_GAP_S
from coec.io.serialise import degrees_or_null, matrix_of
from coec.io.user_files import read_bytes
from coec.io.zenoh.bus import StreamInput, Undeclarable, direct, input_of
from coec.io.zenoh.player import repeated, shifted
from coec.schemas.keys import Keys
from coec.schemas.message import from_json, from_msgpack
from coec.schemas.replies import AxisReply, CalibrationResult, ExtrinsicReply, HealthReply, MetricReply, Transform
from coec.service.ingest.decoder import CAMERA, EGO, LIDAR, PACKETS_WAITING, Decoder
from coec.service.ingest.inbox import Inbox, Parcel

AGAIN_S = 1.0
"""Time between two lines of the timeline, and between two redraws of the pair for viewers who connected since."""

POLL_S = 0.05
"""Time between two checks whether there is a viewer."""

DEFAULT_PERIOD_NS = 100_000_000
"""Time between two passes of a recording with a single frame: 10 Hz."""

MAX_BYTES = 2**20
"""Most bytes of a result or a document of the service; they have some 10 kB."""

STALE: Final = 3
"""ROS level of an unknown state."""

EXPLANATIONS = {
    viewer_scene.NOT_SERVED: "Nobody serves the pair: its service is down, or its router is.",
    viewer_scene.SILENT: "The service is there, and does not answer.",
    viewer_scene.RECORDED: "A recording: no service looks at it.",
}
"""Explanations of the states that are not states of health."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """The result in a file, and its T_camera_lidar (4, 4)."""

    result: CalibrationResult
    T_camera_lidar: Matrix4


def load_candidate(path: Path) -> Candidate:
    """The result in a file.

    Raises:
        SourceError: the file cannot be read, or holds no result, or one that is no rigid transform.
    """
    try:
        result = from_json(CalibrationResult, read_bytes(path, MAX_BYTES))
    except DecodeError as error:
        raise SourceError(f"{path} is not the result of `coec calibrate --json`: {error}") from error
    T_camera_lidar = matrix_of(result.camera_from_lidar)
    if not se3.is_rigid(T_camera_lidar):
        raise SourceError(f"{path}: camera_from_lidar is not a rigid transform")
    return Candidate(result, T_camera_lidar)


@dataclass(frozen=True, slots=True)
class Playback:
    """What is played, and how. `rate`: multiple of the recorded speed, above zero. `candidate`: may be None."""

    recording: RecordingSource
    candidate: Candidate | None
    rate: float
    repeat: bool


class PairOnScreen:
    """The pair that is on the screen, and the state that is shown with it."""

    def __init__(self, playback: Playback, screen: ViewerServer) -> None:
        rig, served = playback.recording.rig, playback.recording.T_camera_lidar_start
        configuration = playback.recording.configuration
        self._rig = rig
        self._screen = screen
        self._extrinsics = extrinsics_of_recording(rig, served, playback.candidate)
        self._moment = moment_of_recording(rig, served, playback.candidate)
        self._compensated = configuration is None or configuration.motion_compensation
        self._pair: FramePair | None = None
        self._state_s = self._picture_s = -math.inf
        self.refused: Counter[str] = Counter()

    def put(self, pair: FramePair) -> None:
        """Show another pair."""
        self._pair = pair
        self._show_picture()

    def rest(self, until: Callable[[], bool], stop: threading.Event) -> None:
        """Wait until a condition holds, or until a signal; meanwhile show state and picture again now and then."""
        while not stop.is_set():
            now_s = time.monotonic()
            if now_s - self._state_s >= AGAIN_S:
                self._state_s = now_s
                self._screen.send_entry(self._moment)
            if now_s - self._picture_s >= AGAIN_S:
                self._show_picture()
            if until():
                break
            stop.wait(POLL_S)

    def rest_until(self, due_s: float, stop: threading.Event) -> None:
        """Wait until a time of the steady clock."""
        self.rest(lambda: time.monotonic() >= due_s - POLL_S, stop)
        stop.wait(min(max(due_s - time.monotonic(), 0.0), POLL_S))

    def _show_picture(self) -> None:
        self._picture_s = time.monotonic()
        requested = self._screen.requested_topics
        if self._pair is None or not requested & viewer_scene.PICTURE_TOPICS:
            return
        try:
            picture = viewer_scene.picture_of(
                self._pair, self._rig, self._extrinsics, requested, LimitsConfig(), compensated=self._compensated
            )
        except DecodeError as error:
            self.refused[error.reason] += 1
            self._pair = None
        else:
            self._screen.send_picture(picture)


def show_recording(playback: Playback, screen: ViewerServer, stop: threading.Event) -> Counter[str]:
    """Plays the recording from the arrival of the first viewer; its last pair stays on the screen until a signal.
    Returns the number of pairs that could not be shown, by cause.

    Raises:
        SourceError: a file cannot be read, or no camera frame has a sweep.
    """
    shown = PairOnScreen(playback, screen)
    shown.rest(lambda: bool(screen.requested_topics & viewer_scene.PICTURE_TOPICS), stop)
    due_s, before_ns = time.monotonic(), None
    for pair in _pairs(playback):
        # A recording that cannot be read as fast as it was recorded takes longer; nothing is left out.
        step_ns = 0 if before_ns is None else pair.stamp_ns - before_ns
        due_s, before_ns = max(due_s + step_ns / NS_PER_S / playback.rate, time.monotonic()), pair.stamp_ns
        shown.rest_until(due_s, stop)
        if stop.is_set():
            return shown.refused
        shown.put(pair)
    shown.rest(lambda: False, stop)
    return shown.refused


def _pairs(playback: Playback) -> Iterator[FramePair]:
    """All pairs in order, again and again if the recording is repeated; sensor time goes on."""
    recording = playback.recording
    expects_motion = len(recording.motion_stamps_ns) > 0
    pairer = Pairer(PairingConfig(max_stamp_jump_s=RECORDED_GAP_S), expects_motion=expects_motion)
    stamps_ns = recording.camera_stamps_ns
    period_ns = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else DEFAULT_PERIOD_NS
    end_ns = math.inf if not stamps_ns else 2 * stamps_ns[-1] - stamps_ns[0] + period_ns
    any_pair = False
    for message in repeated(recording.messages, shifted, 0, period_ns, playback.repeat):
        for pair in pairer.push(message):
            any_pair = True
            yield pair
        if not any_pair and message.stamp_ns > end_ns:
            break
    for pair in pairer.flush():
        any_pair = True
        yield pair
    if not any_pair:
        raise SourceError(
            f"{recording.name}: no camera frame has a sweep within {PairingConfig().tolerance_s} s: check the stamps "
            "of both"
        )


def moment_of_recording(rig: Rig, served: Matrix4, candidate: Candidate | None) -> viewer_scene.TimelineEntry:
    """The line for a recording and a candidate."""
    result = candidate.result if candidate else None
    return viewer_scene.TimelineEntry(
        pair=rig.pair,
        state=viewer_scene.RECORDED,
        level=STALE,
        why=" ".join(one.text for one in result.verdict.reasons) if result else EXPLANATIONS[viewer_scene.RECORDED],
        reasons=tuple(one.code for one in result.verdict.reasons) if result else (viewer_scene.RECORDED,),
        provenance="nominal" if np.array_equal(served, rig.T_camera_lidar_nominal) else "restored",
        status=result.status if result else None,
        candidate=candidate is not None,
        correction=axes_of(degrees_or_null(se3.difference(served, rig.T_camera_lidar_nominal))),
        sigma=axes_of(result.sigma if result else ()),
        step=axes_of(degrees_or_null(se3.difference(candidate.T_camera_lidar, served)) if candidate else ()),
        figures=figures_of(result.metrics if result else {}),
    )


def extrinsics_of_recording(
    rig: Rig, served: Matrix4, candidate: Candidate | None
) -> dict[viewer_scene.DisplayedPose, viewer_scene.TitledExtrinsic]:
    """The extrinsics that are drawn while a recording is played."""
    return {
        viewer_scene.DisplayedPose.SERVED: viewer_scene.TitledExtrinsic(served, "served: when this was recorded"),
        viewer_scene.DisplayedPose.NOMINAL: viewer_scene.TitledExtrinsic(
            rig.T_camera_lidar_nominal, "nominal: of the recording"
        ),
        viewer_scene.DisplayedPose.CANDIDATE: (
            viewer_scene.TitledExtrinsic(candidate.T_camera_lidar, f"candidate: {candidate.result.status}")
            if candidate
            else viewer_scene.TitledExtrinsic(None, "candidate: none")
        ),
    }


def axes_of(values: Sequence[float | None]) -> viewer_scene.PoseAxes:
    """Axes from six values, degrees and metres, or from none."""
    return viewer_scene.PoseAxes(**dict(zip(viewer_scene.PoseAxes.model_fields, values, strict=False)))


def figures_of(metrics: Mapping[str, MetricReply]) -> tuple[viewer_scene.TimelineFigure, ...]:
    return tuple(
        viewer_scene.TimelineFigure(name=name, value=one.value, limit=one.limit, passed=one.passed)
        for name, one in sorted(metrics.items())
    )


# --- a running vehicle ------------------------------------------------------------------------------------------------

REPEAT_S = 1.0
"""Time between two lines of the timeline while nothing changes."""

WAIT_S = 0.05
"""How long to wait for frames before everything else is updated."""

MUTE = (
    "Nothing comes on {}: see that somebody publishes it, and that the router's rules let this session subscribe to it."
)

SERVICE = "service"
"""Name under which refused documents of the service are counted."""

SILENT_S = 10.0
"""A service without an answer for so long, five queries, counts as silent."""

QUERY_S = 2.0
"""Time between two queries, and the timeout of an answer."""

WAITING = 64
"""Documents that may wait to be read, of at most `MAX_BYTES` each; the oldest are dropped."""

HEALTH, EXTRINSIC = "health", "extrinsic"

DEPTHS = {CAMERA: 4, LIDAR: 4, EGO: 512}
"""Samples that may wait; the oldest are dropped. A pair needs its neighbours in time, and two seconds of ego-motion."""

PATIENCE_S = 5.0
"""Time after which a stream without samples is reported."""

BUSY_S = 0.2
"""Time after which the newest pair so far is shown, even if more samples wait."""

_SILENT = logging.Logger("view")
_SILENT.addHandler(logging.NullHandler())


@dataclass(frozen=True, slots=True, eq=False)
class VehiclePair:
    """Which pair of which vehicle."""

    keys: Keys
    pair: PairConfig
    rig: Rig
    config: Config


@dataclass(frozen=True, slots=True)
class ServiceState:
    """The last replies of a service about a pair.

    Attributes:
        alive: whether its liveliness token is there.
        answer_age_s: time since its last reply; None: there was none.
        served, candidate: (4, 4) T_camera_lidar of `extrinsic`, checked to be rigid.
    """

    alive: bool = False
    answer_age_s: float | None = None
    health: HealthReply | None = None
    extrinsic: ExtrinsicReply | None = None
    served: Matrix4 | None = None
    candidate: Matrix4 | None = None

    @property
    def state(self) -> str:
        """State of the pair: that of its health, as long as the service is there and answers."""
        if not self.alive:
            return viewer_scene.NOT_SERVED
        if self.health is None or self.answer_age_s is None or self.answer_age_s > SILENT_S:
            return viewer_scene.SILENT
        return self.health.state


def show_live(session: zenoh.Session, vehicle: VehiclePair, screen: ViewerServer, stop: threading.Event) -> None:
    """Shows the pair until a signal."""
    name = vehicle.pair.name
    streams = SensorStreams(session, vehicle.pair, vehicle.config)
    service = ServiceWatch(session, vehicle.keys, name, lambda cause: streams.refused(SERVICE, cause))
    timeline = _Timeline(screen, name)
    try:
        with service.listening():
            while not stop.is_set():
                requested = screen.requested_topics
                streams.listen(enabled=bool(requested & viewer_scene.PICTURE_TOPICS))
                pair = streams.newest(WAIT_S)
                state = service.update()
                timeline.update(moment_of_service(name, state, streams.ages_s, streams.not_shown), streams.mute)
                if pair is not None:
                    try:
                        screen.send_picture(_picture(pair, vehicle, state, requested))
                    except DecodeError as error:
                        streams.refused(CAMERA, error.reason)
    finally:
        streams.close()


class _Timeline:
    """Writes the timeline and the log: changes at once, and an unchanged state once a second."""

    def __init__(self, screen: ViewerServer, pair: str) -> None:
        self._screen = screen
        self._pair = pair
        self._shown: viewer_scene.TimelineEntry | None = None
        self._shown_s = -math.inf
        self._mute: tuple[str, ...] = ()

    def update(self, moment: viewer_scene.TimelineEntry, mute: tuple[str, ...]) -> None:
        """Update the present state; `mute` are subscribed keys on which nothing is received."""
        changed = self._shown is None or _essence(self._shown) != _essence(moment)
        if changed or time.monotonic() - self._shown_s >= REPEAT_S:
            self._screen.send_entry(moment)
            self._shown, self._shown_s = moment, time.monotonic()
        if changed:
            self._screen.send_log(moment.level, f"{moment.state}: {moment.why}", self._pair)
        if mute and mute != self._mute:
            self._screen.send_log(1, MUTE.format(", ".join(mute)), self._pair)
        self._mute = mute


def _picture(
    pair: FramePair, vehicle: VehiclePair, service: ServiceState, requested: frozenset[str]
) -> viewer_scene.PairPicture:
    compensated = vehicle.pair.calibration.motion_compensation
    extrinsics = extrinsics_of_service(vehicle.rig, service)
    return viewer_scene.picture_of(
        pair, vehicle.rig, extrinsics, requested, vehicle.config.limits, compensated=compensated
    )


def _essence(moment: viewer_scene.TimelineEntry) -> tuple[object, ...]:
    """The part of a moment whose change is worth a line in the log."""
    return moment.state, moment.reasons, moment.provenance, moment.candidate


def moment_of_service(
    pair: str, service: ServiceState, ages_s: Mapping[str, float | None], not_shown: Counter[tuple[str, str]]
) -> viewer_scene.TimelineEntry:
    """The line for a service and its sensors. `ages_s` is the time since a frame was received, by stream; `not_shown`
    counts frames by stream and cause. Figures are the last known ones, whatever the state; `answer_s` is their age."""
    health, extrinsic = service.health, service.extrinsic
    current = health is not None and service.state == health.state
    return viewer_scene.TimelineEntry(
        pair=pair,
        state=service.state,
        level=health.level if health is not None and current else STALE,
        why=" ".join(one.text for one in health.reasons) if health and current else EXPLANATIONS[service.state],
        reasons=tuple(one.code for one in health.reasons) if health and current else (service.state,),
        needs=health.needs if health else (),
        provenance=extrinsic.provenance if extrinsic else None,
        status=extrinsic.status if extrinsic else None,
        percent_complete=extrinsic.percent_complete if extrinsic else None,
        candidate=service.candidate is not None,
        ages=viewer_scene.StreamAges(
            camera_s=ages_s.get("camera"),
            lidar_s=ages_s.get("lidar"),
            ego_s=ages_s.get("ego"),
            answer_s=service.answer_age_s,
        ),
        pair_rate_hz=health.data_quality.pair_rate_hz if health else None,
        sync_error_s=health.data_quality.sync_error_s if health else None,
        correction=axes_of([one.correction for one in _axis_replies(extrinsic)]),
        sigma=axes_of([one.sigma for one in _axis_replies(extrinsic)]),
        step=axes_of(extrinsic.pending.step or () if extrinsic and extrinsic.pending else ()),
        figures=figures_of(health.metrics if health else {}),
        not_shown=tuple(
            viewer_scene.MissedFrames(stream=stream, cause=cause, count=count)
            for (stream, cause), count in sorted(not_shown.items())
        ),
    )


def extrinsics_of_service(
    rig: Rig, service: ServiceState
) -> dict[viewer_scene.DisplayedPose, viewer_scene.TitledExtrinsic]:
    """The extrinsics that are drawn while a service is watched."""
    provenance = service.extrinsic.provenance if service.extrinsic else "not known"
    pending = service.extrinsic.pending if service.extrinsic else None
    waits = pending.waits.code if pending and pending.waits else "waits for apply"
    return {
        viewer_scene.DisplayedPose.SERVED: viewer_scene.TitledExtrinsic(
            service.served, f"served: {provenance}, {service.state}"
        ),
        viewer_scene.DisplayedPose.NOMINAL: viewer_scene.TitledExtrinsic(
            rig.T_camera_lidar_nominal, "nominal: of the configuration"
        ),
        viewer_scene.DisplayedPose.CANDIDATE: viewer_scene.TitledExtrinsic(
            service.candidate, f"candidate: {'none' if service.candidate is None else waits}"
        ),
    }  # fmt: skip


def _axis_replies(extrinsic: ExtrinsicReply | None) -> Iterable[AxisReply]:
    if extrinsic is None:
        return ()
    axes = extrinsic.axes
    return (axes.rx, axes.ry, axes.rz, axes.tx, axes.ty, axes.tz)


@dataclass(frozen=True, slots=True)
class _Document:
    """A received document: its kind, when it was requested (steady clock; None: it was published) and received, and its
    bytes (None: it is larger than any of ours)."""

    kind: str
    requested_s: float | None
    received_s: float
    payload: bytes | None


class ServiceWatch:
    """The state of one pair. One thread uses it; Zenoh's threads only store received documents."""

    def __init__(self, session: zenoh.Session, keys: Keys, pair: str, refused: Callable[[str], None]) -> None:
        """`refused` is called with the cause for each document that cannot be read."""
        self._session = session
        self._keys = {HEALTH: keys.health(pair), EXTRINSIC: keys.extrinsic(pair)}
        self._alive_key = keys.alive(pair)
        self._refused = refused
        self._received: deque[_Document] = deque(maxlen=WAITING)
        self._alive = False
        self._requested_s = float("-inf")
        self._published_s = dict.fromkeys(self._keys, float("-inf"))
        self._answered_s: float | None = None
        self._health: HealthReply | None = None
        self._extrinsic: ExtrinsicReply | None = None
        self._served: Matrix4 | None = None
        self._candidate: Matrix4 | None = None

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Subscribe to changes, and to whether a service serves the pair."""
        subscribers = [
            self._session.declare_subscriber(key, direct(self._listener(kind, None)))
            for kind, key in self._keys.items()
        ]
        token = self._session.liveliness().declare_subscriber(
            self._alive_key, direct(self._on_liveliness), history=True
        )
        try:
            yield
        finally:
            for subscriber in subscribers:
                subscriber.undeclare()
            token.undeclare()

    def update(self) -> ServiceState:
        """The last replies of the service; queries it again when it is time to."""
        now_s = time.monotonic()
        if now_s - self._requested_s >= QUERY_S:
            self._requested_s = now_s
            for kind, key in self._keys.items():
                handler = direct(self._on_reply(self._listener(kind, now_s)))
                # Any other mode of consolidation keeps the answers in Zenoh until the query ends.
                self._session.get(key, handler, consolidation=zenoh.ConsolidationMode.NONE, timeout=QUERY_S)
        while self._received:
            self._decode(self._received.popleft())
        return ServiceState(
            alive=self._alive,
            answer_age_s=None if self._answered_s is None else now_s - min(self._answered_s, now_s),
            health=self._health,
            extrinsic=self._extrinsic,
            served=self._served,
            candidate=self._candidate,
        )

    def _decode(self, document: _Document) -> None:
        if document.requested_s is None:
            self._published_s[document.kind] = document.received_s
        elif document.requested_s <= self._published_s[document.kind]:
            return  # what was published in the meantime is newer than this answer, or the same
        try:
            if document.payload is None:
                raise DecodeError("message_too_large", f"more than {MAX_BYTES} bytes")
            if document.kind == HEALTH:
                self._health = from_msgpack(HealthReply, document.payload)
            else:
                reply = from_msgpack(ExtrinsicReply, document.payload)
                served = _rigid(reply.camera_from_lidar)
                candidate = None if reply.pending is None else _rigid(reply.pending.camera_from_lidar)
                self._extrinsic, self._served, self._candidate = reply, served, candidate
        except DecodeError as error:
            self._refused(error.reason)
            return
        self._answered_s = document.received_s

    def _listener(self, kind: str, requested_s: float | None) -> Callable[[zenoh.Sample], None]:
        def on_sample(sample: zenoh.Sample) -> None:
            fits = len(sample.payload) <= MAX_BYTES
            payload = sample.payload.to_bytes() if fits else None
            self._received.append(_Document(kind, requested_s, time.monotonic(), payload))

        return on_sample

    @staticmethod
    def _on_reply(on_sample: Callable[[zenoh.Sample], None]) -> Callable[[zenoh.Reply], None]:
        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                on_sample(reply.ok)

        return on_reply

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        self._alive = sample.kind == zenoh.SampleKind.PUT


def _rigid(transform: Transform) -> Matrix4:
    T_camera_lidar = matrix_of(transform)
    if not se3.is_rigid(T_camera_lidar):
        raise DecodeError("message_fields", "the matrix is not a rigid transform")
    return T_camera_lidar


class SensorStreams:
    """The sensors of one pair. Subscriptions exist only while there is a viewer, so that an unwatched viewer costs the
    vehicle nothing. A slow viewer loses frames here, not on the vehicle."""

    def __init__(self, session: zenoh.Session, pair: PairConfig, config: Config) -> None:
        self._session = session
        self._pair = pair
        self._limits = config.limits
        self._losses = LossCounter(_SILENT, pair.name)
        self._inputs = {name: input_of(stream, config) for name, stream in pair.streams.items()}
        self._subscribers: list[Undeclarable] = []
        self._begin()

    def _begin(self) -> None:
        self._decoders = {
            name: Decoder(name, stream, self._limits, self._losses) for name, stream in self._pair.streams.items()
        }
        self._pairer = Pairer(self._pair.pairing, expects_motion=self._pair.ego is not None)
        self._since_s = time.monotonic()
        depths = {**DEPTHS, LIDAR: PACKETS_WAITING} if self._pair.lidar.has_packets else DEPTHS
        self._inbox = Inbox(depths, self._limits.max_waiting_bytes, self._overrun)

    @property
    def not_shown(self) -> Counter[tuple[str, str]]:
        """Frames that were received and not shown, by stream and cause: refused, or without a partner since there is a
        viewer. Gaps in sequence numbers do not count, because most frames are skipped here anyway."""
        counts = {cause: count for cause, count in self._losses.snapshot().items() if cause[1] != "sequence_gap"}
        for name, count in self._pairer.losses.items():
            stream, _, cause = name.partition("_")
            counts[stream, cause] = count
        return Counter(counts)

    @property
    def ages_s(self) -> dict[str, float | None]:
        """Time since a sample was received, by stream; None: none since there is a viewer. Empty without a viewer."""
        if not self._subscribers:
            return {}
        arrivals = self._inbox.arrivals(time.monotonic())
        return {stream: arrivals[stream].age_s for stream in self._inputs}

    @property
    def mute(self) -> tuple[str, ...]:
        """Keys and topics on which nothing has been received although there has been a viewer for `PATIENCE_S`."""
        if time.monotonic() - self._since_s < PATIENCE_S:
            return ()
        return tuple(self._pair.streams[stream].place for stream, age_s in self.ages_s.items() if age_s is None)

    def listen(self, *, enabled: bool) -> None:
        """Subscribe if frames are requested, else unsubscribe."""
        if enabled and not self._subscribers:
            self._begin()
            self._subscribers = [
                subscriber
                for name, source in self._inputs.items()
                for subscriber in source.declared(self._session, self._receiver(name, source))
            ]
        elif not enabled:
            self.close()

    def newest(self, wait_s: float) -> FramePair | None:
        """The newest pair of the received samples; older pairs are skipped. None: nothing was received within `wait_s`,
        or it made no pair."""
        pair = None
        parcel = self._inbox.take(wait_s)
        end_s = time.monotonic() + BUSY_S
        while isinstance(parcel, Parcel):
            frame = self._decoders[parcel.stream].frame(parcel.sample)
            formed = [] if frame is None else self._pairer.push(frame)
            pair = formed[-1] if formed else pair
            parcel = self._inbox.take(0.0) if time.monotonic() < end_s else None
        return pair

    def refused(self, stream: str, cause: str) -> None:
        """Count something that could not be shown or understood."""
        self._losses.add(stream, cause)

    def _overrun(self, parcel: Parcel) -> None:
        self._decoders[parcel.stream].overrun(parcel.sample)

    def close(self) -> None:
        """Withdraw the subscriptions."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers = []

    def _receiver(self, stream: str, source: StreamInput) -> Callable[[zenoh.Sample, bool], None]:
        inbox = self._inbox

        def receive(sample: zenoh.Sample, is_description: bool) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            if len(sample.payload) > self._limits.max_message_bytes:
                self._losses.add(stream, "message_too_large")
                return
            inbox.put(stream, source.sample(sample, is_description))

        return receive
