"""Answers about one pair, from snapshots that the managing thread made and from the disk; and those about a pending
pair: that it is pending, and what is missing. For any thread. The list of a pair's recordings is serialised only
when it has changed, because thousands make a megabyte. Pictures are rendered on demand by the worker, so that no
thread of the service is held up; the latest ones are cached.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Never

from coec.calibration.state import CalibrationStatus, Health
from coec.calibration.state_machine import HealthState
from coec.calibration.types import Matrix4, Reason, Rig
from coec.config import Config, OpenPairConfig, PairConfig, config_hash
from coec.errors import CoecError, NotAcceptedError, NotFoundError
from coec.io.exported_extrinsic import ExportFrames
from coec.io.exports import FORMATS
from coec.io.ros.messages import CAMERA_INFO
from coec.io.serialise import reasons_of, result_of
from coec.io.zenoh.bus import Answer
from coec.schemas import replies
from coec.schemas.keys import Format
from coec.service.api import problems, reply_builders
from coec.service.api.command_execution import PendingPairCommands
from coec.service.discovery import info_topic_of
from coec.service.discovery_listener import NominalStatus
from coec.service.engine.messages import PairSnapshot
from coec.service.ingest.pair_stream import PairStream
from coec.service.recording.recorder import Recorder
from coec.service.recording.snippets import SNIPPET, SnippetStore
from coec.service.recording.window_store import WindowStore
from coec.service.records.incidents import NO_EVENT, Side
from coec.service.records.pair_store import PairStore
from coec.service.vehicle_context import VehicleContext
from coec.service.worker import compilation, worker_jobs
from coec.service.worker.supervisor import Worker


@dataclass(frozen=True, slots=True)
class _CachedListing:
    """A listing, and the answers that were made of it."""

    windows: tuple[replies.WindowInfo, ...]
    snippets: tuple[replies.SnippetInfo, ...]
    answers: dict[Format, Answer] = field(default_factory=dict)


class WindowsList:
    """The list of one pair. For any thread."""

    def __init__(self, vehicle: str, pair: str, windows: WindowStore, snippets: SnippetStore | None) -> None:
        self._vehicle, self._pair = vehicle, pair
        self._windows, self._snippets = windows, snippets
        self._listing = _CachedListing((), ())

    def answer(self, form: Format) -> Answer:
        """The present list in the encoding that is asked for."""
        windows = self._windows.listing(self._pair)
        snippets = () if self._snippets is None else self._snippets.listing(self._pair)
        listing = self._listing
        # The store hands out the same tuple until it changes. Identity is compared, because comparing thousands of
        # entries takes as long as packing them.
        if listing.windows is not windows or listing.snippets != snippets:
            listing = self._listing = _CachedListing(windows, snippets)
        answer = listing.answers.get(form)
        if answer is None:
            reply = replies.WindowsReply(vehicle=self._vehicle, pair=self._pair, windows=windows, snippets=snippets)
            answer = listing.answers[form] = reply_builders.answer_of(reply, form)
        return answer


CACHED_OVERLAYS = 4
"""How many pictures are kept, some hundred kB each."""

OVERLAY_TIMEOUT_S = 8.0
"""Longest wait for a picture, s: below the 10 s after which clients give up. The worker may be solving."""


class OverlayUnavailableError(CoecError):
    """The worker could not draw the picture, or not in time."""

    reply_code = "not_drawn"


class Overlays:
    """Draws the windows of one pair."""

    def __init__(self, pair: str, worker: Worker) -> None:
        self._pair = pair
        self._worker = worker
        self._lock = threading.Lock()
        self._cache: OrderedDict[tuple[str, bytes], bytes] = OrderedDict()

    def jpeg(self, path: Path, T_camera_lidar: Matrix4, title: str) -> bytes:
        """JPEG of a window with its points drawn at an extrinsic (4, 4); waits for the worker.

        Raises:
            OverlayUnavailableError: the picture did not come.
        """
        key = (path.stem, T_camera_lidar.tobytes())
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        rendered: Future[worker_jobs.JobOutcome] = Future()
        job = worker_jobs.overlay(self._pair, path, T_camera_lidar, title, rendered.set_result, OVERLAY_TIMEOUT_S)
        self._worker.submit(job)
        try:
            outcome = rendered.result(OVERLAY_TIMEOUT_S)
        except TimeoutError as error:
            raise OverlayUnavailableError("the worker is busy with a window; retry") from error
        if outcome.reason is not None:
            raise OverlayUnavailableError(outcome.reason.text)
        assert isinstance(outcome.answer, worker_jobs.RenderedImage)
        picture = outcome.answer.jpeg
        with self._lock:
            self._cache[key] = picture
            while len(self._cache) > CACHED_OVERLAYS:
                self._cache.popitem(last=False)
        return picture


class PairAnswers:
    """The answers of one pair."""

    def __init__(
        self,
        pair: PairConfig,
        config: Config,
        rig: Rig,
        store: PairStore,
        folder: WindowStore,
        recorder: Recorder,
        stream: PairStream,
        context: VehicleContext,
        commands: Callable[[], dict[str, int]],
    ) -> None:
        """Nothing can be answered before `on_update` was called once. `commands()` returns the counts of commands."""
        self.name = pair.name
        self._pair = pair
        self._vehicle = config.vehicle
        self._config_hash = config_hash(pair.calibration)
        self._store = store
        self._folder = folder
        self._recorder = recorder
        self._stream = stream
        self._context = context
        self._commands = commands
        self._overlays = Overlays(pair.name, context.worker)
        self._windows = WindowsList(config.vehicle, pair.name, folder, context.snippets)
        self.rig = rig
        self.extrinsic_reply: replies.ExtrinsicReply
        """What `extrinsic` serves."""
        self._known: PairSnapshot
        self._health: reply_builders.StampedReply
        self._snapshots: dict[str, reply_builders.SerializedReply] = {}
        self._published: dict[str, object] = {}
        self._lock = threading.Lock()
        self._fault: Reason | None = None

    def reconfigure(self, pair: PairConfig) -> None:
        """Answers by these settings from now on. For any thread."""
        self._pair, self._config_hash = pair, config_hash(pair.calibration)

    # --- on the thread of the engine; `fail` on the main thread -----------------------------------------------------

    def on_update(self, known: PairSnapshot) -> None:
        """Serialises the answers anew, and publishes what has changed."""
        report, rig = self._stream.report, self.rig
        accepted = None if known.state.accepted is None else result_of(known.state.accepted, rig, self._vehicle)
        extrinsic = reply_builders.extrinsic_of(
            self._vehicle, rig, known.state, accepted, self.percent_complete, self._config_hash
        )
        own = () if self._recorder.problem is None else (self._recorder.problem,)
        topics, arrivals = self._context.topics(), self._context.vehicle.arrivals(self._stream.sensors)
        changed = self._context.nominal(self.name).changed
        stream_reasons = (
            *problems.stream_problems(report.streams, self._pair, topics),
            *(() if changed is None else (changed,)),
        )
        problems_of_pair = (
            *own,
            *stream_reasons,
            *self._context.rig_problems(self.name),
            *self._context.vehicle_problems(),
        )
        missed = problems.missed_of(arrivals, self._pair, topics)
        health = reply_builders.health_of(
            known, report, self._stream.losses(), problems_of_pair, missed, self._pair, rig, self._vehicle
        )
        with self._lock:
            if self._fault is not None:
                health = _failing(health, self._fault)
            self._known, self._health = known, reply_builders.StampedReply(health, time.monotonic())
            self.extrinsic_reply = extrinsic
            self._snapshots = {
                "extrinsic": reply_builders.SerializedReply.of(extrinsic),
                "health": reply_builders.SerializedReply.of(health),
            }
        essences = {
            "extrinsic": extrinsic.model_copy(update={"percent_complete": 0.0}),
            "health": (health.state, tuple(map(_essence, health.reasons)), health.needs, known.solved),
        }
        for name, essence in essences.items():
            if self._published.get(name) != essence:
                self._published[name] = essence
                key = f"{self._context.keys.root}/{self.name}/{name}"
                self._context.publish(key, self._snapshots[name].answer("msgpack"))

    def fail(self, reason: Reason) -> None:
        """Reports that the service is about to end, for this reason, from now on, whatever the thread of the engine is
        doing."""
        with self._lock:
            self._fault = reason
            failed = _failing(self._health.reply, reason)
            self._health = reply_builders.StampedReply(failed, time.monotonic())
            self._snapshots = {**self._snapshots, "health": reply_builders.SerializedReply.of(failed)}
        self._context.publish(f"{self._context.keys.root}/{self.name}/health", self.health("msgpack"))

    # --- on any -----------------------------------------------------------------------------------------------------

    @property
    def calibrated(self) -> "PairAnswers":
        """What a pair with a calibration answers."""
        return self

    @property
    def recorded(self) -> int:
        """Number of windows recorded since the start."""
        return self._recorder.recorded

    @property
    def newest_event(self) -> str | None:
        """Id of the newest incident that is kept; None if there is none."""
        newest = self._store.incidents.newest
        return None if newest is None else newest.event_id

    @property
    def health_reply(self) -> replies.HealthReply:
        """What `health` serves."""
        return self._health.now()

    @property
    def percent_complete(self) -> float:
        """How complete the open window is, percent."""
        return 100.0 * min(self._stream.report.selection.selected / self._pair.window.pairs, 1.0)

    def extrinsic(self, form: Format) -> Answer:
        """The current calibration, serialised in advance."""
        return self._snapshots["extrinsic"].answer(form)

    def exported(self, form: str, frames: ExportFrames) -> Answer:
        """The current calibration as a file of another program.

        Raises:
            NotAcceptedError: it is still the nominal calibration.
            OutputError: a frame has a name that not every format can hold.
        """
        camera, lidar = self._pair.camera, self._pair.lidar
        own = (lidar.frame_id, camera.frame_id)
        exportable = reply_builders.exported(
            self._known.state, self._vehicle, self.name, own, camera.intrinsics, frames
        )
        if exportable.origin.rejection_reasons:
            raise NotAcceptedError(" ".join(exportable.origin.rejection_reasons))
        written = FORMATS[form]
        return Answer(written.text(exportable, None).encode(), written.encoding)

    def health(self, form: Format) -> Answer:
        """The health, serialised at most a second ago. If it is much older, the answer says so."""
        stamped, reply = self._health, self._health.now()
        return (
            self._snapshots["health"].answer(form) if reply is stamped.reply else reply_builders.answer_of(reply, form)
        )

    def history(self, since_ns: int, until_ns: int, limit: int) -> replies.HistoryReply:
        """Past results, other entries and checks with a sensor stamp in the bounds, the newest `limit` of each. Entries
        without a sensor stamp are dated by the wall clock."""
        records = self._store.publishable_records()
        results = records.results

        def inside(entry: replies.HistoryEntry) -> bool:
            return since_ns <= (entry.wall_ns if entry.stamp_ns is None else entry.stamp_ns) <= until_ns

        return replies.HistoryReply(
            vehicle=self._vehicle,
            pair=self.name,
            total=len(results),
            results=tuple(result for result in results if since_ns <= result.data_stamp_ns <= until_ns)[-limit:],
            entries=tuple(record.chained for record in records.entries if inside(record.entry))[-limit:],
            checks=tuple(check for check in records.checks if since_ns <= check.stamp_ns <= until_ns)[-limit:],
        )

    def windows(self, form: Format) -> Answer:
        """The recorded windows, and the snippets of the seconds around events."""
        return self._windows.answer(form)

    def read_window(self, window_id: str, offset: int, length: int) -> bytes:
        """Bytes of the file of a window, or of a snippet.

        Raises:
            NotFoundError: no such window of this pair.
            UsageError: the offset lies beyond the end of the file.
        """
        snippets = self._context.snippets
        if snippets is not None and window_id.endswith(SNIPPET):
            return snippets.read(self.name, window_id, offset, length)
        return self._folder.read(self.name, window_id, offset, length)

    def events(self) -> replies.EvidenceReply:
        """The incidents that are kept, without their figures."""
        bare = tuple(event.model_copy(update={"metrics": ()}) for event in self._store.publishable_records().events)
        return replies.EvidenceReply(vehicle=self._vehicle, pair=self.name, events=bare)

    def event(self, event_id: str) -> replies.EvidenceEvent:
        """One incident with its figures.

        Raises:
            NotFoundError: no such event.
        """
        incident = next(
            (event for event in self._store.publishable_records().events if event.event_id == event_id), None
        )
        if incident is None:
            raise NotFoundError(NO_EVENT)
        return incident

    def event_overlay(self, event_id: str, side: Side) -> bytes:
        """JPEG of the window before or after an event.

        Raises:
            NotFoundError: no such event, or it has no such picture.
        """
        return self._store.incidents.overlay(event_id, side)

    def overlay(self, window_id: str | None, *, nominal: bool) -> bytes:
        """JPEG of a window (None: the latest) with its points drawn at the current or the nominal extrinsic.

        Raises:
            NotFoundError: no such window.
            OverlayUnavailableError: the worker has no time for it, or cannot draw it.
        """
        latest = self._recorder.latest
        if window_id is None and (latest is None or not latest.exists()):
            raise NotFoundError(f"pair {self.name} has no window yet")
        path = latest if window_id is None and latest else self._folder.existing(self.name, str(window_id))
        pose = self.rig.T_camera_lidar_nominal if nominal else self._known.served.T_camera_lidar
        return self._overlays.jpeg(path, pose, f"{path.stem}  {'nominal' if nominal else 'current'}")

    def status(self) -> replies.PairStatus:
        """Counters since the start."""
        counted = reply_builders.pair_status_of(
            self.name,
            self._known,
            self._stream.report,
            self._stream.losses(),
            self._recorder.recorded,
            self._commands(),
            self._context.vehicle.arrivals(self._stream.sensors),
            self._recorder.waiting,
            has_ego=self._pair.ego is not None,
        )
        nominal = self._context.nominal(self.name)
        losses = {**counted.losses, **nominal.losses}
        return counted.model_copy(update={"losses": losses, "found": dict(nominal.origins)})


def _failing(reply: replies.HealthReply, reason: Reason) -> replies.HealthReply:
    """The reply of a service that is about to end for a reason."""
    health = reply_builders.with_problems(Health(HealthState(reply.state), ()), (reason,))
    update = {
        "state": health.state.value,
        "level": replies.ROS_LEVELS[health.state.value],
        "reasons": (*reply.reasons, *reasons_of(health.reasons)),
    }
    return reply.model_copy(update=update)


def _essence(reason: replies.Reason) -> str:
    """What has to change of a reason for health to be published anew: the code; of a compilation the progress, too."""
    return reason.text if reason.code == compilation.CODE else reason.code


class PendingPairError(CoecError):
    """The pair has no nominal calibration yet, so there is nothing to serve."""

    reply_code = "awaiting"


class PendingPairAnswers:
    """The answers of one pair. `renew` is for the main thread, once a second."""

    def __init__(self, pair: OpenPairConfig, vehicle: str, context: VehicleContext) -> None:
        self.name = pair.name
        self._vehicle = vehicle
        self._context = context
        self._pair = pair
        self._since_ns = time.time_ns()
        self._published: object = None
        self._fault: tuple[Reason, ...] = ()
        self.commands = PendingPairCommands(pair.name, vehicle, self._missing)
        self.renew()

    def _missing(self) -> PendingPairError:
        awaits = (reason.text for reason in self._nominal.awaits)
        return PendingPairError(" ".join(["This pair waits for its nominal calibration.", *awaits]))

    @property
    def _nominal(self) -> NominalStatus:
        return self._context.nominal(self.name)

    def renew(self) -> None:
        """Serialises the answers anew, and publishes what has changed."""
        awaits = self._nominal.awaits
        reasons = (*awaits, *self._context.vehicle_problems(), *self._fault)
        self.health_reply = replies.HealthReply(
            vehicle=self._vehicle,
            pair=self.name,
            state=HealthState.UNKNOWN.value,
            level=replies.ROS_LEVELS[HealthState.UNKNOWN.value],
            reasons=reasons_of(reasons),
            metrics={},
            axes=reply_builders.axes_of(None, CalibrationStatus.NOT_ACCEPTED),
            needs=(*(reason.text for reason in awaits), *self._absent()),
            data_quality=replies.DataQuality(),
            since_ns=self._since_ns,
            evaluated_ns=None,
            age_s=None,
        )
        self._snapshot = reply_builders.SerializedReply.of(self.health_reply)
        if self._published != reasons:
            self._published = reasons
            self._context.publish(self._context.keys.health(self.name), self._snapshot.answer("msgpack"))

    def _absent(self) -> list[str]:
        """A sentence for each wanted topic that nobody publishes; it lists the topics that exist."""
        topics, pair = self._context.topics(), self._pair
        required = [(stream.topic, stream.types) for stream in pair.streams.values()]
        required.append((info_topic_of(pair), (CAMERA_INFO,)))
        sentences = (None if topic is None else topics.absent(topic, types) for topic, types in required)
        return [sentence for sentence in sentences if sentence is not None]

    def fail(self, reason: Reason) -> None:
        """Reports that the service is about to end, for this reason."""
        self._fault = (reason,)
        self.renew()

    def status(self) -> replies.PairStatus:
        """Status with what is missing; there is hardly anything to count."""
        return replies.PairStatus(
            name=self.name,
            ego=replies.StreamStatus() if self._pair.ego is not None else None,
            commands=self.commands.counted(),
            losses=dict(self._nominal.losses),
            awaits=reasons_of(self._nominal.awaits),
            found=dict(self._nominal.origins),
        )

    def health(self, form: Format) -> Answer:
        """The health: unknown, with the reasons."""
        return self._snapshot.answer(form)

    @property
    def calibrated(self) -> Never:
        """Refuses every other question.

        Raises:
            PendingPairError: there is no nominal calibration yet.
        """
        raise self._missing()
