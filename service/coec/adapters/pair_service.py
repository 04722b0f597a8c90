"""The flow of one camera-LiDAR pair: samples to windows, windows to the worker, results to what is served.

Three threads meet here, and each owns its part: the ingest thread the streams (pairing, window), the recorder thread
the files, the worker's supervisor the results. What they share is immutable and replaced as a whole under one lock.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path

from coec.adapters import snapshots
from coec.adapters.depth import STEREO
from coec.adapters.images import Inspector
from coec.adapters.inbox import Call, Inbox
from coec.adapters.intake import CAMERA, EGO, LIDAR, Intake, StreamCounts
from coec.adapters.logs import LossCounter
from coec.adapters.msgpack_frames import encode_camera
from coec.adapters.recorder import Recorder, RecordingPlan
from coec.adapters.rig import rig_of
from coec.adapters.sensor_clock import NS_PER_S, SensorClock
from coec.adapters.snapshots import Snapshot
from coec.adapters.state_store import History, StateStore
from coec.adapters.threads import ServiceThread
from coec.adapters.window_folder import WindowFolder
from coec.adapters.wire import estimate_of, result_of
from coec.adapters.worker import SUPERSEDED, Solved, SolveJob, Worker
from coec.adapters.zenoh_bus import Answer
from coec.calibration.lifecycle import (
    Health,
    HealthState,
    PairState,
    after_estimate,
    after_failure,
    assess,
    initial_state,
)
from coec.calibration.pairing import Pairer
from coec.calibration.values import FramePair, ImageQuality, Matrix4, Reason
from coec.calibration.window import PairSelected, SliceEnded, WindowCutter
from coec.config import Config, PairConfig, config_hash
from coec.errors import StateError
from coec.schemas import replies
from coec.schemas.base import from_msgpack
from coec.schemas.keys import Format, Keys
from coec.schemas.replies import CalibrationResult

_log = logging.getLogger(__name__)

FRAMES_WAITING = 16
"""Samples of camera or LiDAR that may wait for the ingest thread: 1.6 s at 10 Hz, some 40 MB in all."""

MOTIONS_WAITING = 512
"""Ego-motion samples that may wait: 2.5 s at 200 Hz."""

GRACE_NS = NS_PER_S
"""Sensor time after the end of a slice before silence ends it: late pairs may still be on their way."""

IDLE_S = 0.25
COMMAND_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class StreamReport:
    """What the ingest thread last said of itself."""

    streams: dict[str, StreamCounts] = field(default_factory=dict)
    unpaired: dict[str, int] = field(default_factory=dict)
    rejections: dict[str, int] = field(default_factory=dict)
    pairs: int = 0
    selected: int = 0
    quality: ImageQuality | None = None
    frozen: bool = False
    rate_hz: float | None = None
    sync_error_s: float | None = None


@dataclass(frozen=True, slots=True)
class Outside:
    """What a pair has in common with the others of the vehicle."""

    keys: Keys
    store: StateStore
    folder: WindowFolder
    worker: Worker
    publish: Callable[[str, Answer], None]
    vehicle_troubles: Callable[[], tuple[Reason, ...]]


class PairService:
    """Serves one pair. Attributes `ingest` and `recorder.thread` are its threads; `inbox` takes its samples."""

    def __init__(self, pair: PairConfig, config: Config, outside: Outside) -> None:
        """Build the pair and recall its state; `refresh` must be called before anything is asked.

        Raises:
            ConfigError: the rig cannot be built.
        """
        self.name = pair.name
        self._pair = pair
        self._config = config
        self._outside = outside
        self._rig = rig_of(pair)
        self.losses = LossCounter(_log, pair.name)
        depths = {CAMERA: FRAMES_WAITING, LIDAR: FRAMES_WAITING, EGO: MOTIONS_WAITING}
        self.inbox = Inbox(depths, lambda stream: self.losses.add(stream, "overrun"))
        plan = RecordingPlan(
            self._rig, pair.calibration, pair.window.min_pairs, {"vehicle": config.vehicle, "pair": pair.name}
        )
        self.recorder = Recorder(plan, outside.folder, self.losses, self._on_recorded)
        self.ingest = ServiceThread(f"ingest-{pair.name}", self._run)
        # The ingest thread's own.
        self._intake = Intake(pair, config.limits, self.losses)
        self._pairer = Pairer(pair.pairing, expects_motion=pair.ego is not None)
        self._cutter = WindowCutter(pair.window, self._rig, Inspector(config.limits))
        self._clock = SensorClock()
        self._pairs = 0
        self._sync_error_s: float | None = None
        self._frozen = False
        self._report = StreamReport()
        # Shared.
        self._lock = threading.RLock()
        self._damage: Reason | None = None
        self._evaluated_s: float | None = None
        self._state = self._recall()
        self._history = History(config.state.directory / f"history-{pair.name}.jsonl", config.state.history)
        if self._history.damaged:
            self.losses.add("storage", "history_damaged", self._history.damaged)
        self._solved = 0
        self._health = Health(HealthState.UNKNOWN, ())
        self._since_ns = time.time_ns()
        self._served: dict[str, Snapshot] = {}
        self._published: dict[str, object] = {}

    # --- asked from outside -----------------------------------------------------------------------------------------

    @property
    def health_state(self) -> HealthState:
        """The state that `health` serves."""
        return self._health.state

    @property
    def percent_complete(self) -> float:
        """Of the open window."""
        return 100.0 * min(self._report.selected / self._pair.window.pairs, 1.0)

    def extrinsic(self, form: Format) -> Answer:
        """The current calibration, serialised before."""
        return self._served["extrinsic"].answer(form)

    def health(self, form: Format) -> Answer:
        """The health, serialised at most a tick ago."""
        return self._served["health"].answer(form)

    def history(self, since_ns: int, until_ns: int, limit: int) -> replies.HistoryReply:
        """Past results with `data_stamp_ns` in the bounds, the newest `limit` of them."""
        results = self._history.results()
        chosen = tuple(result for result in results if since_ns <= result.data_stamp_ns <= until_ns)[-limit:]
        return replies.HistoryReply(vehicle=self._config.vehicle, pair=self.name, total=len(results), results=chosen)

    def windows(self) -> replies.WindowsReply:
        """The recorded windows."""
        return replies.WindowsReply(
            vehicle=self._config.vehicle, pair=self.name, windows=self._outside.folder.listing(self.name)
        )

    def read_window(self, window_id: str, offset: int, length: int) -> bytes:
        """Bytes of one window's file.

        Raises:
            NotFoundError: no such window of this pair.
            UsageError: the offset lies behind its end.
        """
        return self._outside.folder.read(self.name, window_id, offset, length)

    def status(self) -> replies.PairStatus:
        """Counters since the start."""
        report = self._report
        drops = snapshots.drops_of(self.losses.snapshot(), report.unpaired)

        def stream(name: str) -> replies.StreamStatus:
            counts = report.streams.get(name, StreamCounts(0, 0))
            return replies.StreamStatus(received=counts.received, accepted=counts.accepted, losses=drops.get(name, {}))

        return replies.PairStatus(
            name=self.name,
            camera=stream(CAMERA),
            lidar=stream(LIDAR),
            ego=stream(EGO) if self._pair.ego else None,
            pairs=report.pairs,
            selected=report.selected,
            rejections=report.rejections,
            losses={**drops.get("window", {}), **drops.get("storage", {})},
            windows=self.recorder.recorded,
            solved=self._solved,
        )

    def calibrate(self) -> replies.Acknowledgement:
        """Finish the open window now if it has enough pairs, and solve it; else solve the latest window again."""
        done: Future[replies.Acknowledgement] = Future()
        self.inbox.call(lambda: done.set_result(self._calibrate_now()))
        try:
            return done.result(COMMAND_TIMEOUT_S)
        except TimeoutError:
            return self._acknowledge("busy", "The streams keep the service busy; ask again.", accepted=False)

    def take_sample(self, stream: str, payload: bytes, encoding: str) -> None:
        """A sample came: microseconds, on the network's thread."""
        self.inbox.put(stream, payload, encoding)

    def refresh(self) -> None:
        """Serialise what is served anew, and publish what changed. The daemon calls it every second."""
        with self._lock:
            state = self._state
            rig, vehicle = self._rig, self._config.vehicle
            accepted = result_of(state.accepted, rig, vehicle) if state.accepted else None
            latest = result_of(state.latest, rig, vehicle) if state.latest else None
            fallback_hash = config_hash(self._pair.calibration)
            extrinsic = snapshots.extrinsic_of(vehicle, rig, state, accepted, self.percent_complete, fallback_hash)
            health = self._health_reply(state, latest)
            self._served = {"extrinsic": Snapshot.of(extrinsic), "health": Snapshot.of(health)}
            changed = {
                "extrinsic": extrinsic.model_copy(update={"percent_complete": 0.0}),
                "health": (health.state, tuple(reason.code for reason in health.reasons), health.needs, self._solved),
            }
            for name, essence in changed.items():
                if self._published.get(name) != essence:
                    self._published[name] = essence
                    key = f"{self._outside.keys.root}/{self.name}/{name}"
                    self._outside.publish(key, self._served[name].answer("msgpack"))

    # --- on the ingest thread ---------------------------------------------------------------------------------------

    def request_stop(self) -> None:
        """End the ingest thread; the recorder is stopped afterwards, when nothing more can come to it."""
        self.ingest.request_stop()
        self.inbox.wake()

    def finish_window(self) -> None:
        """End the open window; for the end of the service, after the ingest thread has ended."""
        self._offer(self._pairer.flush())
        for event in self._cutter.finish():
            self._end(event)

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            item = self.inbox.take(IDLE_S)
            if isinstance(item, Call):
                item.run()
            elif item is not None:
                frame = self._intake.frame(item)
                if frame is not None:
                    self._offer(self._pairer.push(frame))
            self._end_in_silence()
            self._tell()

    def _offer(self, pairs: list[FramePair]) -> None:
        for pair in pairs:
            self._pairs += 1
            self._clock.observe(pair.stamp_ns, time.monotonic())
            self._sync_error_s = (pair.camera.stamp_ns - pair.lidar.stamp_ns) / NS_PER_S
            T_camera_lidar = self._state.T_camera_lidar
            frozen_before = self._cutter.rejections["frozen"]
            for event in self._cutter.offer(pair, T_camera_lidar):
                if isinstance(event, PairSelected):
                    self._frozen = False
                    self._select(event, T_camera_lidar)
                else:
                    self._end(event)
            self._frozen |= self._cutter.rejections["frozen"] > frozen_before

    def _select(self, event: PairSelected, T_camera_lidar: Matrix4) -> None:
        self.recorder.add(event.window_id, event.pair, T_camera_lidar)
        if self._pair.calibration.depth.model != STEREO:
            self._outside.worker.prefetch(self.name, encode_camera(event.pair.camera))

    def _end(self, event: SliceEnded) -> None:
        fields = {"window": event.window_id, "pairs": event.pairs, "complete": event.complete}
        _log.info("a slice ended", extra={"fields": fields})
        self.recorder.end(event)

    def _end_in_silence(self) -> None:
        """Let the slice end by extrapolated time when the streams have stopped."""
        end_ns = self._cutter.slice_end_ns
        if end_ns is None:
            return
        now_ns = self._clock.silent_now_ns(time.monotonic())
        if now_ns is None or now_ns < end_ns + GRACE_NS:
            return
        self._offer(self._pairer.flush())
        for event in self._cutter.advance(now_ns):
            self._end(event)

    def _calibrate_now(self) -> replies.Acknowledgement:
        self._offer(self._pairer.flush())
        lacking = self._pair.window.min_pairs - self._cutter.selected
        if lacking <= 0:
            (ended,) = self._cutter.finish()
            self._end(ended)
            return self._acknowledge(
                "window_finished", f"The window of {ended.pairs} pairs is being solved.", window_id=ended.window_id
            )
        latest = self.recorder.latest
        if latest is not None and latest.exists():
            self._outside.worker.solve(SolveJob(self.name, latest.stem, latest))
            return self._acknowledge(
                "window_again",
                f"The latest window is being solved again; {lacking} more pairs are needed for a new one.",
                window_id=latest.stem,
            )
        return self._acknowledge("too_few_pairs", f"{lacking} more pairs needed.", accepted=False)

    def _acknowledge(
        self, code: str, text: str, *, accepted: bool = True, window_id: str | None = None
    ) -> replies.Acknowledgement:
        return replies.Acknowledgement(
            vehicle=self._config.vehicle,
            pair=self.name,
            command="calibrate",
            accepted=accepted,
            code=code,
            text=text,
            window_id=window_id,
        )

    def _tell(self) -> None:
        silent = self._clock.is_silent(time.monotonic())
        rate_hz = self._clock.rate_hz
        self._report = StreamReport(
            streams={stream: self._intake.counts(stream) for stream in (CAMERA, LIDAR, EGO)},
            unpaired=dict(self._pairer.losses),
            rejections={cause: count for cause, count in self._cutter.rejections.items() if count},
            pairs=self._pairs,
            selected=self._cutter.selected,
            quality=self._cutter.last_quality,
            frozen=self._frozen,
            rate_hz=0.0 if silent and rate_hz is not None else rate_hz,
            sync_error_s=self._sync_error_s,
        )

    # --- on the recorder's and the supervisor's threads -------------------------------------------------------------

    def _on_recorded(self, window_id: str, path: Path, live: bool) -> None:
        self._outside.worker.solve(SolveJob(self.name, window_id, path, live))

    def on_solved(self, solved: Solved) -> None:
        """A window was solved: keep the result, serve it, publish it."""
        result = from_msgpack(CalibrationResult, solved.result)
        fields = {"window": result.window_id, "decision": result.verdict.decision, "elapsed_s": solved.elapsed_s}
        _log.info("a window was solved", extra={"fields": fields})
        if solved.note is not None:
            self.losses.add("window", "result_not_written", detail=solved.note.text)
        with self._lock:
            try:
                self._history.append(result)
            except StateError as error:
                self.losses.add("storage", "history_not_saved", detail=str(error))
            self._solved += 1
            latest = self._state.latest
            # A window of an earlier run is old news when a newer one has been evaluated.
            if solved.job.live or latest is None or latest.data_stamp_ns <= result.data_stamp_ns:
                self._become(after_estimate(self._state, estimate_of(result)))
        self.refresh()

    def on_failed(self, job: SolveJob, reason: Reason) -> None:
        """A window came to nothing."""
        self.losses.add("window", reason.code, detail=reason.text)
        if reason is SUPERSEDED or not job.live:
            return
        with self._lock:
            self._become(after_failure(self._state, reason))
        self.refresh()

    def save(self) -> None:
        """Put the state on the disk; a failure is counted."""
        with self._lock:
            age_s = self._age_s()
            evaluated_ns = None if age_s is None else time.time_ns() - round(age_s * NS_PER_S)
            try:
                self._outside.store.remember(self._rig, self._state, evaluated_ns)
            except StateError as error:
                self.losses.add("storage", "state_not_saved", detail=str(error))

    def _become(self, state: PairState) -> None:
        self._state = state
        self._damage = None
        self._evaluated_s = time.monotonic()
        self.save()

    # --- health -----------------------------------------------------------------------------------------------------

    def _recall(self) -> PairState:
        damage = self._outside.store.damage
        try:
            remembered = self._outside.store.recall(self._rig)
        except StateError as error:
            damage, remembered = (*damage, str(error)), None
        if damage:
            source = "the previous copy" if remembered else "the nominal calibration"
            self._damage = Reason("state_damaged", f"The state on the disk was damaged; {source} is served.")
            self.losses.add("storage", "state_damaged", len(damage), detail="; ".join(damage))
        if remembered is None:
            return initial_state(self._rig)
        if remembered.evaluated_wall_ns is not None:
            age_s = max(time.time_ns() - remembered.evaluated_wall_ns, 0) / NS_PER_S
            self._evaluated_s = time.monotonic() - age_s
        return remembered.state

    def _age_s(self) -> float | None:
        return None if self._evaluated_s is None else time.monotonic() - self._evaluated_s

    def _health_reply(self, state: PairState, latest: CalibrationResult | None) -> replies.HealthReply:
        age_s = self._age_s()
        health = self._with_troubles(assess(state, age_s, self._config.stale_after_s))
        if health.state is not self._health.state:
            self._since_ns = time.time_ns()
        self._health = health
        return replies.HealthReply(
            vehicle=self._config.vehicle,
            pair=self.name,
            state=health.state.value,
            level=replies.ROS_LEVELS[health.state.value],
            reasons=snapshots.reasons_of(health.reasons),
            metrics=latest.metrics if latest else {},
            axes=snapshots.axes_of(latest, state.status),
            needs=self._needs(state),
            data_quality=self._data_quality(),
            since_ns=self._since_ns,
            evaluated_ns=latest.data_stamp_ns if latest else None,
            age_s=age_s,
        )

    def _with_troubles(self, health: Health) -> Health:
        """What ails the service itself makes a healthy pair degraded, and is said in every state."""
        own = tuple(reason for reason in (self._damage, self.recorder.trouble) if reason is not None)
        troubles = (*own, *self._outside.vehicle_troubles())
        if not troubles:
            return health
        state = HealthState.DEGRADED if health.state is HealthState.HEALTHY else health.state
        return Health(state, (*health.reasons, *troubles))

    def _needs(self, state: PairState) -> tuple[str, ...]:
        report, needs = self._report, []
        lacking = self._pair.window.min_pairs - report.selected
        if lacking > 0:
            needs.append(f"{lacking} more pairs")
        if self._pair.calibration.motion_compensation:
            compensation = state.latest.compensation if state.latest else {}
            ego = report.streams.get(EGO)
            if self._pair.ego is None or (report.pairs and (ego is None or not ego.accepted)):
                needs.append("motion compensation has no ego-motion")
            elif compensation.get("no_point_time", 0):
                needs.append("motion compensation has no point times")
        return tuple(needs)

    def _data_quality(self) -> replies.DataQuality:
        report = self._report
        drops = snapshots.drops_of(self.losses.snapshot(), report.unpaired)
        if report.rejections:
            drops["pairs"] = report.rejections
        quality = report.quality
        return replies.DataQuality(
            pair_rate_hz=report.rate_hz,
            sync_error_s=report.sync_error_s,
            drops=drops,
            sharpness=quality.sharpness if quality else None,
            mean_level=quality.mean_level if quality else None,
            clipped=quality.clipped if quality else None,
            frozen_image=report.frozen,
        )
