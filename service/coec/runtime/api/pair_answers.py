"""Answers about one pair, from snapshots that the deciding thread made and from the disk. For any thread."""

from __future__ import annotations

import time
from collections.abc import Callable

from coec.adapters.exports import FORMATS
from coec.adapters.exports.told import ExportFrames
from coec.adapters.files.conversions import result_of
from coec.adapters.zenoh.bus import Answer
from coec.calibration.lifecycle import Health, HealthState
from coec.calibration.types import Reason, Rig
from coec.config import Config, PairConfig, config_hash
from coec.errors import NotAcceptedError, NotFoundError
from coec.runtime.api import streams
from coec.runtime.api.exports import exported
from coec.runtime.api.extrinsic import extrinsic_of
from coec.runtime.api.health import StampedReply, health_of, reasons_of, with_problems
from coec.runtime.api.overlays import Overlays
from coec.runtime.api.snapshots import SerializedReply, answer_of
from coec.runtime.api.status import pair_status_of
from coec.runtime.api.windows_list import WindowsList
from coec.runtime.decisions.decider import PairSnapshot
from coec.runtime.decisions.incidents import NO_EVENT, Side
from coec.runtime.decisions.pair_store import PairStore
from coec.runtime.ingest.pair_stream import PairStream
from coec.runtime.outside import VehicleContext
from coec.runtime.recording.recorder import Recorder
from coec.runtime.recording.snippet_store import SNIPPET
from coec.runtime.recording.window_store import WindowStore
from coec.runtime.worker import compilation
from coec.schemas import replies
from coec.schemas.keys import Format


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
        """Nothing can be asked before `hear` was called once. `commands()` returns the counts of commands."""
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
        self._health: StampedReply
        self._snapshots: dict[str, SerializedReply] = {}
        self._published: dict[str, object] = {}

    def reconfigure(self, pair: PairConfig) -> None:
        """Answers by these settings from now on. For any thread."""
        self._pair, self._config_hash = pair, config_hash(pair.calibration)

    # --- on the thread that decides; `fail` on the main thread --------------------------------------------------------

    def on_update(self, known: PairSnapshot) -> None:
        """Serialises the answers anew, and publishes what has changed."""
        report, rig = self._stream.report, self.rig
        accepted = None if known.state.accepted is None else result_of(known.state.accepted, rig, self._vehicle)
        extrinsic = extrinsic_of(self._vehicle, rig, known.state, accepted, self.percent_complete, self._config_hash)
        own = () if self._recorder.problem is None else (self._recorder.problem,)
        topics, arrivals = self._context.topics(), self._stream.arrivals()
        changed = self._context.nominal(self.name).changed
        stream_reasons = (
            *streams.stream_problems(report.streams, self._pair, topics),
            *(() if changed is None else (changed,)),
        )
        problems_of_pair = (
            *own,
            *stream_reasons,
            *self._context.rig_problems(self.name),
            *self._context.vehicle_problems(),
        )
        missed = streams.missed_of(arrivals, self._pair, topics)
        health = health_of(
            known, report, self._stream.losses(), problems_of_pair, missed, self._pair, rig, self._vehicle
        )
        self._known, self._health = known, StampedReply(health, time.monotonic())
        self.extrinsic_reply = extrinsic
        self._snapshots = {"extrinsic": SerializedReply.of(extrinsic), "health": SerializedReply.of(health)}
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
        """Reports that the service is about to end, for this reason, whatever the thread that decides is doing."""
        reply = self._health.reply
        health = with_problems(Health(HealthState(reply.state), ()), (reason,))
        update = {
            "state": health.state.value,
            "level": replies.ROS_LEVELS[health.state.value],
            "reasons": (*reply.reasons, *reasons_of(health.reasons)),
        }
        failed = reply.model_copy(update=update)
        self._health = StampedReply(failed, time.monotonic())
        self._snapshots = {**self._snapshots, "health": SerializedReply.of(failed)}
        self._context.publish(f"{self._context.keys.root}/{self.name}/health", self.health("msgpack"))

    # --- on any -----------------------------------------------------------------------------------------------------

    @property
    def recorded(self) -> int:
        """Number of windows recorded since the start."""
        return self._recorder.recorded

    @property
    def newest_event(self) -> str | None:
        """Id of the newest red event that is kept; None if there is none."""
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
        exportable = exported(self._known.state, self._vehicle, self.name, own, camera.intrinsics, frames)
        if exportable.origin.rejection_reasons:
            raise NotAcceptedError(" ".join(exportable.origin.rejection_reasons))
        written = FORMATS[form]
        return Answer(written.text(exportable, None).encode(), written.encoding)

    def health(self, form: Format) -> Answer:
        """The health, serialised at most a second ago. If it is much older, the answer says so."""
        stamped, reply = self._health, self._health.now()
        return self._snapshots["health"].answer(form) if reply is stamped.reply else answer_of(reply, form)

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
        """The red events that are kept, without their figures."""
        bare = tuple(event.model_copy(update={"metrics": ()}) for event in self._store.publishable_records().events)
        return replies.EvidenceReply(vehicle=self._vehicle, pair=self.name, events=bare)

    def event(self, event_id: str) -> replies.EvidenceEvent:
        """One red event with its figures.

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
            NotDrawnError: the worker has no time for it, or cannot draw it.
        """
        latest = self._recorder.latest
        if window_id is None and (latest is None or not latest.exists()):
            raise NotFoundError(f"pair {self.name} has no window yet")
        path = latest if window_id is None and latest else self._folder.existing(self.name, str(window_id))
        pose = self.rig.T_camera_lidar_nominal if nominal else self._known.served.T_camera_lidar
        return self._overlays.jpeg(path, pose, f"{path.stem}  {'nominal' if nominal else 'current'}")

    def status(self) -> replies.PairStatus:
        """Counters since the start."""
        counted = pair_status_of(
            self.name,
            self._known,
            self._stream.report,
            self._stream.losses(),
            self._recorder.recorded,
            self._commands(),
            self._stream.arrivals(),
            self._recorder.waiting,
            has_ego=self._pair.ego is not None,
        )
        nominal = self._context.nominal(self.name)
        losses = {**counted.losses, **nominal.losses}
        return counted.model_copy(update={"losses": losses, "found": dict(nominal.origins)})


def _essence(reason: replies.Reason) -> str:
    """What has to change of a reason for health to be published anew: the code; of a compilation the progress, too."""
    return reason.text if reason.code == compilation.CODE else reason.code
