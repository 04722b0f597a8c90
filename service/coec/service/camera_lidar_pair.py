"""One camera-LiDAR pair of the service: its streams, its state machine, and everything outside to which the actions of
the state machine go.
"""

import logging
from collections.abc import Iterable, Mapping
from functools import partial

from coec.calibration.frames.window import SliceClosed
from coec.config import CalibrationConfig, Config, PairConfig
from coec.io.logs import LossCounter
from coec.io.msgpack_frames import encode
from coec.io.rig_files import rig_of
from coec.service.api.command_execution import Commands
from coec.service.api.pair_answers import PairAnswers
from coec.service.configuration import settings_hash
from coec.service.engine import messages
from coec.service.engine.commands import CommandExecutor, PairCommand, Surroundings
from coec.service.engine.frame_selector import FrameSelector
from coec.service.engine.pair import TICK_S, Pair
from coec.service.engine.schedule import Request, Schedule
from coec.service.ingest.decoder import SensorStream, Taker
from coec.service.ingest.pair_stream import FrameRing, PairBuffer, PairStream
from coec.service.recording.recorder import RecordBetween, Recorder, RecordingPlan, RecordPair, WindowRecorded
from coec.service.recording.snippets import SnippetRecorder
from coec.service.records.pair_store import PairStore
from coec.service.records.rig_store import RigBaseline
from coec.service.vehicle_context import VehicleContext
from coec.service.worker import worker_jobs

_log = logging.getLogger(__name__)


class CameraLidarPair:
    """One pair. `answers`, `commands` and `reconfigure` are for any thread; everything else belongs to the thread of
    the engine."""

    def __init__(self, pair: PairConfig, config: Config, context: VehicleContext) -> None:
        """Builds the pair, restores its state from the disk, and has it join the engine.

        Raises:
            ConfigError: the rig cannot be built.
        """
        vehicle, folder, clock = context.vehicle, context.folder, context.vehicle.clock
        self.name = pair.name
        self._pair, self._context = pair, context
        rig, losses = rig_of(pair), LossCounter(_log, pair.name)
        store = PairStore(rig, config.vehicle, config.state, context.store, context.disk_writer, folder, losses, clock)
        baseline = RigBaseline(pair, rig, config.state)
        context.disk_writer.register(baseline)
        member = vehicle.rig.join(pair, rig.T_camera_lidar_nominal, store.state)
        schedule: messages.PairSchedule = Schedule()
        first_slice_s = vehicle.budget.join(pair.name, pair.monitor, pair.window)
        selector = FrameSelector(
            pair,
            config.limits,
            rig,
            store.served,
            schedule,
            vehicle.budget,
            member,
            losses,
            first_slice_s,
            store.carried_over,
        )
        self.engine = Pair(pair, config.stale_after_s, store, baseline, schedule, selector, member, losses, clock)
        self._executor = CommandExecutor(pair, config.vehicle, rig, self.engine, folder, clock)
        self._rig, self._packed, self._metadata = rig, config.state.packing == "lz4", {"vehicle": config.vehicle}
        plan = self._plan(pair, baseline.calibration)
        snippets = None
        if context.snippets is not None:
            snippets = SnippetRecorder(plan.rig, plan.metadata, context.snippets, losses, packed=plan.packed)
        self.recorder = Recorder(plan, folder, losses, context.recording, vehicle.inbox.post, snippets)
        # Half of the pair's share, because as much again is in memory while a snippet is written.
        ring_bytes = config.snippets.memory_bytes // (2 * max(len(config.every_pair), 1))
        ring = None if snippets is None else FrameRing(config.snippets, ring_bytes, snippets.submit)
        held = PairBuffer(vehicle.waiting_frames, config.worker.timeout_s)
        self.stream = PairStream(pair, vehicle.sensors_of(pair), held, losses, ring)
        self.commands = Commands(pair.name, config.vehicle, store, vehicle.inbox)
        self.answers = PairAnswers(
            pair, config, rig, store, folder, self.recorder, self.stream, context, self.commands.counted
        )
        self.engine.publish()
        self._do(self.engine.take_actions())
        vehicle.join(self)
        context.recording.join(self.recorder)  # last, because it posts events to this pair

    def reconfigure(self, pair: PairConfig, stale_after_s: float, history_text: str) -> None:
        """Goes on with other settings, which differ only in what `configuration.RELOADED` names. `history_text` is the
        entry for the history."""
        self.answers.reconfigure(pair)
        self.recorder.follow(self._plan(pair, pair.calibration))
        self._context.vehicle.inbox.post(self.name, messages.Reconfigured(pair, stale_after_s, history_text))

    def _plan(self, pair: PairConfig, calibration: CalibrationConfig) -> RecordingPlan:
        metadata = {**self._metadata, "pair": pair.name, "settings_hash": settings_hash(pair)}
        return RecordingPlan(self._rig, calibration, pair.window.min_pairs, metadata, self._packed)

    # --- on the thread of the engine: see `Receiver` ----------------------------------------------------------------

    @property
    def sensors(self) -> Mapping[str, SensorStream]:
        """The streams, by kind."""
        return self.stream.sensors

    @property
    def unanswered(self) -> int:
        """Number of checks and windows without a result."""
        return self.engine.unanswered

    def taker(self, name: str) -> Taker:
        """The function that takes the frames of a stream; each frame says of which it is."""
        del name
        return self.stream.push

    def on_event(self, event: messages.Event | PairCommand) -> object:
        """Takes an event; returns the acknowledgement of a command."""
        if isinstance(event, PairCommand):
            if event.name == "calibrate":
                self.finish_pairs()
            around = Surroundings(self.recorder.latest, self._context.worker.commissioning(self.name))
            acknowledgement, actions = self._executor.execute(event, around)
            self._do(actions)
            return acknowledgement
        if isinstance(event, messages.JobDone):
            self._release(event)
        elif isinstance(event, messages.Reconfigured):
            self._pair = event.pair
            self._executor.reconfigure(event.pair)
        self._step(event)
        if isinstance(event, WindowRecorded):
            self._context.folder.release(event.window_id)  # which its job holds by now
        return None

    def advance(self, now_s: float) -> bool:
        """Evaluates the oldest frame pair if it may be evaluated: every result that counts before it has come and the
        recorder has room; or it has waited too long, or too many frames wait. Returns whether it did."""
        engine, held = self.engine, self.stream.held
        can_publish = engine.is_unpublished and engine.store.may_be_published()
        if can_publish or now_s - engine.ticked_s >= TICK_S:
            self._tick()
        if not held.pairs:
            return False
        stamp_ns = held.pairs[0].camera.stamp_ns
        engine.warms_up = self._context.worker.warms_up
        self._step(messages.SensorTime(stamp_ns))
        is_forced = not self.recorder.has_room or engine.is_waiting
        if not is_forced:
            held.stop_waiting()
        elif not held.has_waited(now_s):
            return False
        self._step(messages.Evaluate(self.stream.take(now_s), is_forced))
        return True

    def tick(self, now_s: float, *, waiting: bool) -> None:
        """Time has passed; `waiting`: samples of the streams are in the inbox. Ends a slice in silence."""
        self.stream.tick(self.engine.selector.statistics, now_s, waiting=waiting)
        end_ns = self.engine.selector.slice_end_ns
        if end_ns is not None and self.stream.silence_ends(end_ns, now_s):
            self.stream.end_in_silence(end_ns, self.engine.selector.statistics.last_ns, now_s)
            if not self.stream.held.pairs:
                self._step(messages.SensorTime(end_ns))

    def _tick(self) -> None:
        self._step(messages.Tick(self._context.worker.compiled_s, self.stream.report))

    def finish_pairs(self) -> None:
        """Evaluates every frame pair that has come, even if it should wait for a result."""
        now_s = self._context.vehicle.clock.monotonic_s()
        self.stream.flush(now_s)
        while self.stream.held.pairs:
            self._step(messages.SensorTime(self.stream.held.pairs[0].stamp_ns))
            self._step(messages.Evaluate(self.stream.take(now_s), is_forced=True))

    def finish_window(self) -> None:
        """Ends the open window when the service ends; called after the thread of the engine has ended."""
        self.stream.finish_snippet()
        self.finish_pairs()
        closed = self.engine.selector.finish()
        self._do([] if closed is None else [closed])

    def _step(self, event: messages.Event) -> None:
        actions = self.engine.step(event)
        if actions:
            self._do(actions)

    # --- actions ----------------------------------------------------------------------------------------------------

    def _do(self, actions: Iterable[messages.Action]) -> None:
        for action in actions:
            match action:
                case RecordPair() | RecordBetween():
                    self.recorder.add(action)
                case SliceClosed():
                    self.recorder.end(action)
                case messages.UseCalibration():
                    self.recorder.reconfigure(action.calibration)
                case messages.KeepSnippet():
                    self.stream.keep_snippet(action.event, action.T_camera_lidar)
                case messages.Publish():
                    self.answers.on_update(action.snapshot)
                case messages.Prefetch():
                    self._context.worker.prefetch(self.name, encode(action.camera))
                case _:
                    self._context.worker.submit(self._job(action))
                    if isinstance(action, messages.SubmitCheck):
                        self._context.show(self._pair, action.pairs[-1], action.served.T_camera_lidar)

    def _job(
        self,
        action: messages.SubmitCheck | messages.SubmitSolve | messages.SubmitPicture | messages.SubmitCommissioning,
    ) -> worker_jobs.WorkerJob:
        """The job of an action, whose outcome comes back as `JobDone` with the same subject. Windows stay on the disk
        until it has ended."""
        subject = action.request if isinstance(action, messages.SubmitCheck) else action.subject
        done = partial(self._context.vehicle.post_outcome, self.name, subject)
        folder = self._context.folder
        match action:
            case messages.SubmitCheck():
                return worker_jobs.check(
                    self.name, action.calibration, action.served.T_camera_lidar, action.pairs, done
                )
            case messages.SubmitSolve():
                folder.hold(action.subject.window_id)
                return worker_jobs.solve(self.name, action.path, action.subject.window_id, done, action.subject.live)
            case messages.SubmitCommissioning():
                for window_id in action.subject.window_ids:
                    folder.hold(window_id)
                paths = [folder.path(window_id) for window_id in action.subject.window_ids]
                return worker_jobs.commission(self.name, action.calibration, action.pose, paths, done)
            case messages.SubmitPicture():
                path = folder.path(action.window_id)
                if len(action.poses) == 1:
                    return worker_jobs.overlay(self.name, path, action.poses[0], action.captions[0], done)
                (first, second), (one, other) = action.poses, action.captions
                return worker_jobs.comparison(self.name, path, (first, second), (one, other), done)

    def _release(self, event: messages.JobDone) -> None:
        """A job has ended: gives back what was reserved for it."""
        match event.subject:
            case messages.WindowSubject():
                self._context.folder.release(event.subject.window_id)
            case messages.CommissioningSubject():
                for window_id in event.subject.window_ids:
                    self._context.folder.release(window_id)
            case Request():
                self._context.vehicle.budget.release(self.name)
