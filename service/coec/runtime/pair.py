"""The flow of one camera-LiDAR pair: samples to windows and checks, both to the worker, results to what is served.

Three threads meet here, and each owns its part: the ingest thread the streams (pairing, window, checks), the recorder
thread the files, the worker's supervisor the results. What they share is the ledger, which has a lock of its own.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coec.adapters.depth.maps import STEREO
from coec.adapters.files.baseline_file import BASELINES, load_baseline
from coec.adapters.files.conversions import check_of, degrees_or_null, estimate_of, result_of
from coec.adapters.files.rig import rig_of
from coec.adapters.frames.msgpack_frames import encode_camera
from coec.adapters.images.codec import Inspector
from coec.adapters.system.logs import LossCounter
from coec.adapters.system.threads import ServiceThread
from coec.adapters.zenoh.bus import Answer
from coec.calibration import lifecycle
from coec.calibration.commissioning.baseline import Baseline, drift, learned_hash, mismatch
from coec.calibration.frames.pairing import Pairer
from coec.calibration.frames.sampling import CheckSampler
from coec.calibration.frames.window import PairSelected, SliceEnded, WindowCutter
from coec.calibration.lifecycle import Health, HealthState, PairState, Rules
from coec.calibration.monitor.change_detector import Finding, Observation
from coec.calibration.monitor.urgency import Urgency
from coec.calibration.types import Estimate, FramePair, Matrix4, Reason
from coec.config import CalibrationConfig, Config, PairConfig, config_hash
from coec.errors import NotFoundError, StateError
from coec.geometry import se3
from coec.runtime.api import snapshots
from coec.runtime.api.overlays import Overlays
from coec.runtime.api.snapshots import Snapshot
from coec.runtime.decisions.incidents import Side
from coec.runtime.decisions.pair_store import Ledger, Served, Taken
from coec.runtime.decisions.queue import DecisionQueue, Effect, Question
from coec.runtime.decisions.state_store import StateStore
from coec.runtime.ingest.decoder import CAMERA, EGO, LIDAR, Intake, StreamCounts
from coec.runtime.ingest.inbox import Call, Inbox
from coec.runtime.ingest.pair_buffer import HeldPairs
from coec.runtime.ingest.sensor_clock import NS_PER_S, SensorClock
from coec.runtime.ingest.stream_statistics import StreamReport
from coec.runtime.recording.recorder import Recorder, RecordingPlan
from coec.runtime.recording.window_store import WindowStore, start_ns_of
from coec.runtime.worker.messages import pack_pairs, pack_pose, unpack_observation
from coec.runtime.worker.supervisor import SUPERSEDED, Errand, Solved, SolveJob, Worker
from coec.schemas import replies
from coec.schemas.base import from_msgpack
from coec.schemas.keys import Format, Keys
from coec.schemas.replies import CalibrationResult, EvidenceEvent

_log = logging.getLogger(__name__)

FRAMES_WAITING = 16
"""Samples of camera or LiDAR that may wait for the ingest thread: 1.6 s at 10 Hz, some 40 MB in all."""

MOTIONS_WAITING = 512
"""Ego-motion samples that may wait: 2.5 s at 200 Hz."""

GRACE_NS = NS_PER_S
"""Sensor time after the end of a slice before silence ends it: late pairs may still be on their way."""

WINDOW_PERIODS = 2
"""Periods of the monitor after the end of a window from which on its result counts in the choice of further pairs: at
10 s more than a solve takes, so that a live stream does not wait. The result of a check counts after one period."""

IDLE_S = 0.25
COMMAND_TIMEOUT_S = 10.0

CHECKS_IN_VAIN = 3
"""Checks in a row that came to nothing, from which on health says so."""

COMMISSIONING_WINDOWS = 8
"""Windows that a rig is commissioned from, the newest: 200 pairs."""

COMMISSIONING_TIMEOUT_S = 900.0
"""A commissioning calibrates its windows many times over."""


@dataclass(frozen=True, slots=True)
class Outside:
    """What a pair has in common with the others of the vehicle."""

    keys: Keys
    store: StateStore
    folder: WindowStore
    worker: Worker
    publish: Callable[[str, Answer], None]
    vehicle_troubles: Callable[[], tuple[Reason, ...]]


class PairService:
    """Serves one pair. Attributes `ingest` and `recorder.thread` are its threads; `inbox` takes its samples, `ledger`
    keeps its state."""

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
        self._rules = Rules(pair.policy, pair.tracker)
        self.losses = LossCounter(_log, pair.name)
        depths = {CAMERA: FRAMES_WAITING, LIDAR: FRAMES_WAITING, EGO: MOTIONS_WAITING}
        self.inbox = Inbox(depths, lambda stream: self.losses.add(stream, "overrun"))
        self._baseline_trouble: Reason | None = None
        self._baseline = self._load_baseline()
        plan = RecordingPlan(
            self._rig, self._calibration(), pair.window.min_pairs, {"vehicle": config.vehicle, "pair": pair.name}
        )
        self.recorder = Recorder(plan, outside.folder, self.losses, self._on_recorded, self._on_lost)
        self.ingest = ServiceThread(f"ingest-{pair.name}", self._run)
        # The ingest thread's own.
        self._intake = Intake(pair, config.limits, self.losses)
        self._pairer = Pairer(pair.pairing, expects_motion=pair.ego is not None)
        self._cutter = WindowCutter(pair.window, self._rig, Inspector(config.limits))
        self._sampler = CheckSampler(pair.monitor, pair.window)
        self._urgency = Urgency(pair.monitor, pair.window)
        self._clock, self._pace = SensorClock(), SensorClock()
        self._held = HeldPairs(config.limits.max_held_bytes, config.worker.timeout_s)
        self._last_ns = self._window_due_ns = 0
        self._unasked: list[tuple[FramePair, ...]] = []
        self._period_ns = round(pair.monitor.period_s * NS_PER_S)
        self._pairs = 0
        self._sync_error_s: float | None = None
        self._frozen = False
        self._report = StreamReport()
        # Shared.
        self.ledger = Ledger(self._rig, config.vehicle, config.state, outside.store, outside.folder, self.losses)
        self._view = self.ledger.served
        self._decisions = DecisionQueue()
        self._asked: dict[str, Question] = {}
        self._overlays = Overlays(pair.name, outside.worker)
        self._lock = threading.RLock()
        self._latest_check: replies.CheckReply | None = None
        self._checks = 0
        self._checks_in_vain = 0
        self._monitor_trouble: Reason | None = None
        self._solved = 0
        self._health: replies.HealthReply
        self._served: dict[str, Snapshot] = {}
        self._published: dict[str, object] = {}
        self._commands: dict[str, int] = {}

    # --- asked from outside -----------------------------------------------------------------------------------------

    @property
    def health_reply(self) -> replies.HealthReply:
        """What `health` serves, at most a tick old."""
        return self._health

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
        """Past results and other entries with a sensor stamp in the bounds, the newest `limit` of each; entries that
        have none are dated by the wall clock."""
        entries = self.ledger.history.entries()
        results = self.ledger.history.results()

        def inside(kept: replies.HistoryEntry) -> bool:
            return since_ns <= (kept.wall_ns if kept.stamp_ns is None else kept.stamp_ns) <= until_ns

        return replies.HistoryReply(
            vehicle=self._config.vehicle,
            pair=self.name,
            total=len(results),
            results=tuple(result for result in results if since_ns <= result.data_stamp_ns <= until_ns)[-limit:],
            entries=tuple(kept.chained for kept in entries if inside(kept.entry))[-limit:],
            checks=tuple(check for check in self.ledger.checks() if since_ns <= check.stamp_ns <= until_ns)[-limit:],
        )

    def windows(self) -> replies.WindowsReply:
        """The recorded windows."""
        return replies.WindowsReply(
            vehicle=self._config.vehicle, pair=self.name, windows=self._outside.folder.listing(self.name)
        )

    def evidence(self) -> replies.EvidenceReply:
        """Red events that are kept."""
        return self.ledger.evidence.listing(self._config.vehicle)

    def read_window(self, window_id: str, offset: int, length: int) -> bytes:
        """Bytes of one window's file.

        Raises:
            NotFoundError: no such window of this pair.
            UsageError: the offset lies behind its end.
        """
        return self._outside.folder.read(self.name, window_id, offset, length)

    def overlay(self, window_id: str | None, *, nominal: bool) -> bytes:
        """JPEG of a window's (None: the latest one's) points at the current, or the nominal, extrinsic.

        Raises:
            NotFoundError: no such window.
            NotDrawnError: the worker has no time, or cannot.
        """
        latest = self.recorder.latest
        if window_id is None and (latest is None or not latest.exists()):
            raise NotFoundError(f"pair {self.name} has no window yet")
        path = latest if window_id is None and latest else self._outside.folder.existing(self.name, str(window_id))
        pose = self._rig.T_camera_lidar_nominal if nominal else self.ledger.state.T_camera_lidar
        return self._overlays.jpeg(path, pose, f"{path.stem}  {'nominal' if nominal else 'current'}")

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
            held=len(self._held),
            selected=report.selected,
            rejections=report.rejections,
            losses={**drops.get("window", {}), **drops.get("storage", {}), **drops.get("monitor", {})},
            windows=self.recorder.recorded,
            solved=self._solved,
            checks=self._checks,
            transitions=dict(self.ledger.transitions),
            commands=dict(self._commands),
        )

    def take_sample(self, stream: str, payload: bytes, encoding: str) -> None:
        """A sample came: microseconds, on the network's thread."""
        self.inbox.put(stream, payload, encoding)

    def refresh(self) -> None:
        """Serialise what is served anew, and publish what changed. The daemon calls it every second."""
        self.ledger.age(self._config.stale_after_s)
        with self._lock:
            state = self.ledger.state
            rig, vehicle = self._rig, self._config.vehicle
            accepted = result_of(state.accepted, rig, vehicle) if state.accepted else None
            latest = result_of(state.latest, rig, vehicle) if state.latest else None
            extrinsic = snapshots.extrinsic_of(
                vehicle,
                rig,
                state,
                accepted,
                self.percent_complete,
                config_hash(self._pair.calibration),
                self._pair.tracker,
            )
            health = self._health = self._health_of(state, latest)
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

    # --- commands ---------------------------------------------------------------------------------------------------

    def command(self, name: str, arguments: dict[str, Any], sender: str) -> replies.Acknowledgement:
        """Carry out a command of `commands.NAMES`, or say why not; either is logged and written down."""
        carry_out: dict[str, Callable[[], replies.Acknowledgement]] = {
            "calibrate": self._calibrate,
            "apply": self._apply,
            "rollback": partial(self._roll_back, arguments.get("to")),
            "reset": self._reset,
            "commission": self._commission,
            "hold": partial(self._hold, release=bool(arguments.get("release", False))),
        }
        try:
            acknowledged = carry_out[name]()
        except lifecycle.CommandRefusedError as error:
            acknowledged = self._acknowledge(name, error.code, str(error), accepted=False)
        except NotFoundError as error:
            acknowledged = self._acknowledge(name, error.reply_code, str(error), accepted=False)
        accepted, code = acknowledged.accepted, acknowledged.code
        outcome = f"{name}_{'accepted' if accepted else 'refused'}"
        self._commands[outcome] = self._commands.get(outcome, 0) + 1
        fields = {"pair": self.name, "command": name, "sender": sender, "accepted": accepted, "code": code}
        _log.info("a command came", extra={"fields": fields})
        self.ledger.note_command(name, code, acknowledged.text, sender, accepted=accepted)
        self.ledger.save()
        self.refresh()
        return acknowledged

    def _calibrate(self) -> replies.Acknowledgement:
        """Finish the open window now if it has enough pairs, and solve it; else solve the latest window again."""
        done: Future[replies.Acknowledgement] = Future()
        self.inbox.call(lambda: done.set_result(self._calibrate_now()))
        try:
            return done.result(COMMAND_TIMEOUT_S)
        except TimeoutError:
            text = "The streams keep the service busy; ask again."
            return self._acknowledge("calibrate", "busy", text, accepted=False)

    def _apply(self) -> replies.Acknowledgement:
        self.ledger.update(partial(lifecycle.apply_pending, rules=self._rules), None, looked=False)
        return self._replaced("apply", "applied", "The candidate is served from now on.")

    def _roll_back(self, to: str | None) -> replies.Acknowledgement:
        kept, result = self.ledger.accepted_calibration(to)
        told = kept.entry.camera_from_lidar or result.camera_from_lidar
        pose, estimate = np.array(told.matrix, dtype=np.float64), estimate_of(result)
        self.ledger.update(lambda state: lifecycle.rolled_back(state, pose, estimate, self._rules), None, looked=False)
        text = f"The calibration {kept.sha256[:16]} is served again; the next accepted window may move it: see `hold`."
        return self._replaced("rollback", "rolled_back", text, result.window_id)

    def _reset(self) -> replies.Acknowledgement:
        self.ledger.update(lambda state: lifecycle.reset(state, self._rig), None, looked=False)
        text = "The workshop calibration is served; the next accepted window may move it: see `hold`."
        return self._replaced("reset", "reset", text)

    def _hold(self, *, release: bool) -> replies.Acknowledgement:
        self.ledger.update(lifecycle.released if release else lifecycle.held, None, looked=False)
        if release:
            return self._acknowledge("hold", "released", "Accepted estimates may be applied again.")
        return self._acknowledge("hold", "held", "The extrinsic stays as it is until it is released.")

    def _replaced(self, name: str, code: str, text: str, window_id: str | None = None) -> replies.Acknowledgement:
        self._latest_check = None
        self.inbox.call(self._start_over)
        return self._acknowledge(name, code, text, window_id=window_id)

    def _commission(self) -> replies.Acknowledgement:
        """Have the worker learn the baseline from the windows that agree with what is served."""
        state, folder = self.ledger.state, self._outside.folder
        agreeing = [
            folder.path(result.window_id)
            for result in self.ledger.history.results()
            if result.status == "accepted"
            and folder.path(result.window_id).exists()
            and lifecycle.agrees(state.T_camera_lidar, estimate_of(result).optimum.T_camera_lidar, self._pair.policy)
        ]
        paths = list(dict.fromkeys(agreeing))[-COMMISSIONING_WINDOWS:]
        if not paths:
            text = "No recorded window agrees with what is served: calibrate first."
            return self._acknowledge("commission", "too_few_windows", text, accepted=False)
        body = {"paths": [str(path) for path in paths], "pose": pack_pose(state.T_camera_lidar)}
        self._outside.worker.run_errand(
            Errand("commission", self.name, body, self._on_commissioned, COMMISSIONING_TIMEOUT_S)
        )
        text = f"The rig is being commissioned from {len(paths)} windows; `history` will say how it went."
        return self._acknowledge("commission", "commissioning", text, window_id=paths[-1].stem)

    def _acknowledge(
        self, name: str, code: str, text: str, *, accepted: bool = True, window_id: str | None = None
    ) -> replies.Acknowledgement:
        return replies.Acknowledgement(
            vehicle=self._config.vehicle,
            pair=self.name,
            command=name,
            accepted=accepted,
            code=code,
            text=text,
            window_id=window_id,
        )

    # --- on the ingest thread ---------------------------------------------------------------------------------------

    def request_stop(self) -> None:
        """End the ingest thread; the recorder is stopped afterwards, when nothing more can come to it."""
        self.ingest.request_stop()
        self.inbox.wake()

    def finish_window(self) -> None:
        """End the open window; for the end of the service, after the ingest thread has ended."""
        self._take(self._pairer.flush())
        self._choose_from_all()
        for event in self._cutter.finish():
            self._end(event, self._last_ns)

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            item = self.inbox.take(0.0 if self._may_choose() else IDLE_S)
            if isinstance(item, Call):
                item.run()
            elif item is not None:
                frame = self._intake.frame(item)
                if frame is not None:
                    self._take(self._pairer.push(frame))
            if self._may_choose():
                self._choose_from_next()
            if item is None:
                self._end_in_silence()
            self._tell()

    def _take(self, pairs: list[FramePair]) -> None:
        """Pairs came: they wait their turn."""
        for pair in pairs:
            self._pairs += 1
            self._clock.observe(pair.stamp_ns, time.monotonic())
            self._sync_error_s = (pair.camera.stamp_ns - pair.lidar.stamp_ns) / NS_PER_S
            self._held.add(pair)

    def _may_choose(self) -> bool:
        """Whether the next pair has come, and all is judged that has to be before it is looked at; or it has waited for
        too long, or with too many."""
        if not self._held:
            return False
        if self.recorder.has_room and not self._decisions.waits(self._held.next_ns):
            self._held.may_go()
            return True
        return self._held.has_waited(time.monotonic())

    def _choose_from_all(self) -> None:
        """Look at every pair that waits, whatever it waits for."""
        while self._held:
            self._choose_from_next()

    def _choose_from_next(self) -> None:
        """Look at the next pair: is it one for the window, one for the monitor?"""
        pair = self._held.take()
        if self._decisions.waits(pair.stamp_ns):
            self.losses.add("monitor", "not_awaited")
        self._decisions.settle(pair.stamp_ns)
        self._last_ns = pair.stamp_ns
        self._pace.observe(pair.stamp_ns, time.monotonic())
        T_camera_lidar = self._view.T_camera_lidar
        for ended in self._urgency.heed(self._cutter, self._pace.rate_hz):
            self._end(ended, pair.stamp_ns)
        frozen_before = self._cutter.rejections["frozen"]
        for event in self._cutter.offer(pair, T_camera_lidar):
            if isinstance(event, PairSelected):
                self._frozen = False
                self._select(event, T_camera_lidar)
            else:
                self._end(event, pair.stamp_ns)
                self._urgency.ended(event, self._cutter, self._pace.rate_hz)
        self._frozen |= self._cutter.rejections["frozen"] > frozen_before
        check = self._sampler.offer(pair)
        if check is not None:
            self._unasked.append(check)
        if pair.stamp_ns >= self._window_due_ns:
            self._check(pair.stamp_ns)

    def _select(self, event: PairSelected, T_camera_lidar: Matrix4) -> None:
        self.recorder.add(event.window_id, event.pair, T_camera_lidar)
        if self._pair.calibration.depth.model != STEREO:
            self._outside.worker.prefetch(self.name, encode_camera(event.pair.camera))

    def _end(self, event: SliceEnded, stamp_ns: int) -> None:
        """A slice ended, at this sensor time: what it holds goes to the disk, and from there to the worker."""
        if event.complete:
            question = self._decisions.ask(stamp_ns + WINDOW_PERIODS * self._period_ns)
            self._asked[event.window_id], self._window_due_ns = question, question.due_ns
        fields = {"window": event.window_id, "pairs": event.pairs, "complete": event.complete}
        _log.info("a slice ended", extra={"fields": fields})
        self.recorder.end(event)

    def _check(self, stamp_ns: int) -> None:
        """Have the worker judge the latest pairs at what is served. While a window is about to change that, they wait:
        they would be judged at what is no longer served."""
        for pairs in self._unasked:
            question = self._decisions.ask(stamp_ns + self._period_ns)
            body = {"pose": pack_pose(self._view.T_camera_lidar), "frames": pack_pairs(pairs)}
            done = partial(self._on_observed, question, self._view.epoch)
            self._outside.worker.check(Errand("check", self.name, body, done))
        self._unasked.clear()

    def _end_in_silence(self) -> None:
        """Let the slice end by extrapolated time when the streams have stopped."""
        end_ns = self._cutter.slice_end_ns
        if end_ns is None or self._held:
            return
        now_ns = self._clock.silent_now_ns(time.monotonic())
        if now_ns is None or now_ns < end_ns + GRACE_NS:
            return
        self._take(self._pairer.flush())
        if self._held:
            return
        for event in self._cutter.advance(now_ns):
            self._end(event, end_ns)

    def _calibrate_now(self) -> replies.Acknowledgement:
        self._take(self._pairer.flush())
        self._choose_from_all()
        lacking = self._pair.window.min_pairs - self._cutter.selected
        if lacking <= 0:
            (ended,) = self._cutter.finish()
            self._end(ended, self._last_ns)
            text = f"The window of {ended.pairs} pairs is being solved."
            return self._acknowledge("calibrate", "window_finished", text, window_id=ended.window_id)
        latest = self.recorder.latest
        if latest is not None and latest.exists():
            self._outside.worker.solve(SolveJob(self.name, latest.stem, latest))
            text = f"The latest window is being solved again; {lacking} more pairs are needed for a new one."
            return self._acknowledge("calibrate", "window_again", text, window_id=latest.stem)
        return self._acknowledge("calibrate", "too_few_pairs", f"{lacking} more pairs needed.", accepted=False)

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

    def _on_lost(self, window_id: str) -> None:
        self._answer(self._asked.pop(window_id, None), lambda: None)

    def on_solved(self, solved: Solved) -> None:
        """A window was solved: keep the result, serve it, publish it."""
        question = self._asked.pop(solved.job.window_id, None) if solved.job.live else None
        self._answer(question, partial(self._take_result, solved))

    def _take_result(self, solved: Solved) -> Effect | None:
        result = from_msgpack(CalibrationResult, solved.result)
        fields = {"window": result.window_id, "decision": result.verdict.decision, "elapsed_s": solved.elapsed_s}
        _log.info("a window was solved", extra={"fields": fields})
        if solved.note is not None:
            self.losses.add("window", "result_not_written", detail=solved.note.text)
        self._check_baseline(result)
        self.ledger.note_result(result)
        self._solved += 1
        latest = self.ledger.state.latest
        # A window of an earlier run is old news when a newer one has been evaluated.
        if solved.job.live or latest is None or latest.data_stamp_ns <= result.data_stamp_ns:
            estimate, start_ns = self._unbiased(estimate_of(result)), start_ns_of(result.window_id)
            self._step(
                lambda state: lifecycle.before_estimate(state, estimate, start_ns, self._rules), result.data_stamp_ns
            )
            self._add_window_after(result.window_id)
            return self._step(
                lambda state: lifecycle.after_estimate(state, estimate, start_ns, self._rules), result.data_stamp_ns
            )
        self.ledger.save()
        return None

    def on_failed(self, job: SolveJob, reason: Reason) -> None:
        """A window came to nothing."""
        self.losses.add("window", reason.code, detail=reason.text)
        if not job.live:
            return

        def take() -> Effect | None:
            if reason is SUPERSEDED:
                return None
            return self._step(lambda state: lifecycle.after_failure(state, reason), None)

        self._answer(self._asked.pop(job.window_id, None), take)

    def _on_observed(self, question: Question, epoch: int, answer: dict[str, Any] | Reason) -> None:
        self._answer(question, partial(self._take_check, epoch, answer))

    def _take_check(self, epoch: int, answer: dict[str, Any] | Reason) -> Effect | None:
        if isinstance(answer, Reason):
            self._note_check_in_vain(answer)
            return None
        self._checks_in_vain, self._monitor_trouble = 0, None
        if (why_not := answer["baseline_not_used"]) is not None:
            self._refuse_baseline(why_not)
        observation = unpack_observation(answer)
        effect = self._step(
            lambda state: lifecycle.after_observation(state, observation), observation.stamp_ns, observation, epoch
        )
        if effect is None:
            self.losses.add("monitor", "check_overtaken")
            return None
        self._checks += 1
        self._latest_check = check_of(observation, self.ledger.state)
        self.ledger.note_check(self._latest_check)
        return effect

    def _note_check_in_vain(self, reason: Reason) -> None:
        """Whoever cannot look must not go on saying that all is well."""
        self.losses.add("monitor", f"check_{reason.code}", detail=reason.text)
        if reason is SUPERSEDED:
            return
        self._checks_in_vain += 1
        if self._checks_in_vain >= CHECKS_IN_VAIN:
            text = f"The last {self._checks_in_vain} checks came to nothing. {reason.text}"
            self._monitor_trouble = Reason("monitor_blind", text)

    def _answer(self, question: Question | None, take: Callable[[], Effect | None]) -> None:
        """An answer came; one to a question that the stream did not ask takes effect at once."""
        if question is not None:
            self._decisions.answer(question, take)
            self.inbox.wake()
        elif (effect := take()) is not None:
            self.inbox.call(effect)
        self.refresh()

    def _step(
        self,
        step: Callable[[PairState], PairState],
        stamp_ns: int | None,
        observation: Observation | None = None,
        epoch: int | None = None,
    ) -> Effect | None:
        """Data were judged: take the step, draw what a red event needs. What it changes for the pairs to come; None
        when the step was meant for another extrinsic."""
        taken = self.ledger.update(step, stamp_ns, looked=True, epoch=epoch)
        if taken is None:
            return None
        before, after = taken.before, taken.after
        if not np.array_equal(before.T_camera_lidar, after.T_camera_lidar):
            self._latest_check = None
        red = HealthState.MISCALIBRATED
        if after.health is red and before.health is not red:
            self._draw_new_event()
        return partial(self._go_on_with, taken, observation is not None)

    # --- on the ingest thread again ---------------------------------------------------------------------------------

    def _go_on_with(self, taken: Taken, by_check: bool) -> None:
        """What a step changes for the pairs to come: the extrinsic at which they are looked at, and how soon a window
        is wanted: soon when the monitor's word has become worse, or a window did not settle it."""
        self._adopt(taken.served)
        before, after = taken.before, taken.after
        if after.monitor.outcome not in (Finding.SUSPECT, Finding.CONFIRMED) or after.flagged_since_ns is None:
            self._urgency.calm()
            return
        waiting = after.pending is not None and after.pending.contradicts
        if not waiting and not (by_check and before.monitor.outcome is after.monitor.outcome):
            self._urgency.alarm(after.flagged_since_ns)

    def _start_over(self) -> None:
        """A person has replaced the extrinsic."""
        self._adopt(self.ledger.served)
        self._urgency.calm()

    def _adopt(self, served: Served) -> None:
        if served.epoch > self._view.epoch:
            self._view = served

    # --- evidence ---------------------------------------------------------------------------------------------------

    def _draw_new_event(self) -> None:
        event = self.ledger.evidence.newest
        if event is None:
            return
        sides: tuple[tuple[Side, str | None], ...] = (("before", event.window_before), ("after", event.window_after))
        for side, window_id in sides:
            if window_id is not None:
                self._draw(event, window_id, side)

    def _add_window_after(self, window_id: str) -> None:
        """The first window that began after a red event did is part of its evidence."""
        waiting, since_ns = self.ledger.evidence.awaiting, self.ledger.state.flagged_since_ns
        if waiting is None or start_ns_of(window_id) < (waiting.stamp_ns if since_ns is None else since_ns):
            return
        self.ledger.evidence.add_window_after(window_id)
        self.ledger.protect()
        self._draw(waiting, window_id, "after")

    def _draw(self, event: EvidenceEvent, window_id: str, side: Side) -> None:
        """A picture for the evidence, at what was served when the event began."""

        def drawn(picture: bytes | Reason) -> None:
            if isinstance(picture, Reason):
                self.losses.add("storage", "overlay_not_drawn", detail=picture.text)
            else:
                self.ledger.evidence.add_overlay(event.event_id, side, picture)

        pose = np.array(event.camera_from_lidar.matrix, dtype=np.float64)
        path = self._outside.folder.path(window_id)
        self._overlays.request(path, pose, f"{window_id}  {side} {event.event_id}", drawn)

    def save(self) -> None:
        """Put the state on the disk."""
        self.ledger.save()

    # --- the commissioned rig ---------------------------------------------------------------------------------------

    def _calibration(self) -> CalibrationConfig:
        """How windows are calibrated: with the limits that were learned on this rig, if they were."""
        configured = self._pair.calibration
        if self._baseline is None:
            return configured
        return configured.model_copy(update={"verdict": self._baseline.verdict(configured.verdict)})

    def _load_baseline(self) -> Baseline | None:
        try:
            baseline = load_baseline(self._config.state.directory / BASELINES, self.name)
        except StateError as error:
            self._baseline_trouble = Reason("baseline_damaged", f"The baseline of the rig cannot be used: {error}")
            return None
        if baseline is None:
            return None
        learned = learned_hash(self._pair.calibration)
        wrong = mismatch(baseline, self._rig, baseline.depth_identity, learned)
        self._baseline_trouble = None if wrong is None else _mismatched(wrong)
        return baseline if wrong is None else None

    def _check_baseline(self, result: CalibrationResult) -> None:
        """Only a result tells which network the worker has opened."""
        baseline = self._baseline
        if baseline is not None and baseline.depth_identity != result.depth_identity:
            self._refuse_baseline("It was made with another depth network.")

    def _refuse_baseline(self, why: str) -> None:
        if self._baseline is not None:
            self._baseline = None
            self._baseline_trouble = _mismatched(why)
            self.recorder.use(self._calibration())

    def _unbiased(self, estimate: Estimate) -> Estimate:
        """What an estimate says once the estimator's bias on this rig is taken out."""
        if self._baseline is None:
            return estimate
        return lifecycle.moved(estimate, self._baseline.unbiased(estimate.optimum.T_camera_lidar), self._rig)

    def _on_commissioned(self, answer: dict[str, Any] | Reason) -> None:
        if isinstance(answer, Reason):
            self.losses.add("window", "commissioning_failed", detail=answer.text)
            self.ledger.note_command("commission", answer.code, f"failed: {answer.text}", "service", accepted=False)
            self.ledger.save()
            return
        self._baseline = self._load_baseline()
        self.recorder.use(self._calibration())
        text = f"Commissioned from {answer['windows']} windows, {answer['pairs']} pairs; baseline {answer['hash']}."
        self.ledger.note_commissioned(text)
        pose = np.array(answer["pose"], dtype=np.float64)
        stamp_ns = self.ledger.evaluated_stamp_ns
        self._answer(None, lambda: self._step(lambda state: lifecycle.after_commissioning(state, pose), stamp_ns))

    # --- health -----------------------------------------------------------------------------------------------------

    def _health_of(self, state: PairState, latest: CalibrationResult | None) -> replies.HealthReply:
        health = self._with_troubles(Health(state.health, state.reasons))
        value, sigma = self._drift(state)
        result_value, result_sigma = self._drift_of_latest(state)
        metrics = dict(latest.metrics) if latest else {}
        return replies.HealthReply(
            vehicle=self._config.vehicle,
            pair=self.name,
            state=health.state.value,
            level=replies.ROS_LEVELS[health.state.value],
            reasons=snapshots.reasons_of(health.reasons),
            metrics={**metrics, **(self._latest_check.metrics if self._latest_check else {})},
            axes=snapshots.axes_of(latest, state.status),
            drift=value,
            drift_sigma=sigma,
            result_drift=result_value,
            result_drift_sigma=result_sigma,
            check=self._latest_check,
            needs=self._report.needs(self._pair, state.latest),
            data_quality=self._report.data_quality(self.losses.snapshot()),
            since_ns=self.ledger.since_ns,
            evaluated_ns=self.ledger.evaluated_stamp_ns,
            age_s=self.ledger.age_s,
        )

    def _drift(self, state: PairState) -> tuple[replies.Maybe6 | None, replies.Maybe6 | None]:
        """From the commissioned calibration, with its standard deviations; None before commissioning."""
        if self._baseline is None:
            return None, None
        sigma = np.full(6, np.nan) if state.accepted is None else state.accepted.sigma
        drifted = drift(se3.perturb(state.T_camera_lidar, self._baseline.bias), sigma, self._baseline)
        return degrees_or_null(drifted.value), degrees_or_null(drifted.sigma)

    def _drift_of_latest(self, state: PairState) -> tuple[replies.Maybe6 | None, replies.Maybe6 | None]:
        """The same of the latest result, which has its bias taken off already."""
        if self._baseline is None or state.latest is None:
            return None, None
        pose = se3.perturb(state.latest.optimum.T_camera_lidar, self._baseline.bias)
        drifted = drift(pose, state.latest.sigma, self._baseline)
        return degrees_or_null(drifted.value), degrees_or_null(drifted.sigma)

    def _with_troubles(self, health: Health) -> Health:
        """What ails the service itself makes a healthy pair degraded, and is said in every state."""
        own = (self.ledger.damage, self._baseline_trouble, self._monitor_trouble, self.recorder.trouble)
        troubles = (*(reason for reason in own if reason is not None), *self._outside.vehicle_troubles())
        if self.ledger.state.frozen:
            troubles = (*troubles, Reason("held", "The extrinsic is held by command."))
        if not troubles:
            return health
        worse = health.state is HealthState.HEALTHY and any(reason.code != "held" for reason in troubles)
        return Health(HealthState.DEGRADED if worse else health.state, (*health.reasons, *troubles))


def _mismatched(text: str) -> Reason:
    return Reason("baseline_mismatch", f"The baseline of the rig is not used: {text}")
