"""Replays a recorded drive through the engine of the service: which checks and windows it makes of it, what it serves,
and when.

The engine is that of the service; no thread runs it. The sensor time of the frames is the clock, so no frame is dropped
and no time passes while a job runs. A result is handed to the engine when the drive has come to the sensor time from
which it counts, so two replays are equal to the byte whatever the machine does. Meanwhile jobs run on worker processes,
and a thread reads ahead. The engine takes the frames as they were read, and checks them as if they were messages.
"""

from __future__ import annotations

import heapq
import os
import queue
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import cast

from coec.calibration.frames.window import SliceClosed
from coec.calibration.types import NS_PER_S, CameraFrame, Frame
from coec.config import BudgetConfig, Config, PairConfig
from coec.errors import SourceError
from coec.io.disk_writer import DiskWriter
from coec.io.recordings.recording_source import CLOUD, IMAGE, MOTION
from coec.io.zenoh.bus import MSGPACK, InputSample
from coec.io.zenoh.player import stream_of
from coec.io.zenoh.ros_node import RosTopicList
from coec.reports.formatting import count
from coec.schemas.keys import Keys
from coec.service.camera_lidar_pair import CameraLidarPair
from coec.service.cpu_budget import Budget
from coec.service.decision_log import MOST_CHECKS, MOST_ENTRIES, ReplayedDrive, Transition, decisions_of
from coec.service.engine import messages
from coec.service.engine.lidar_pairs import LidarPairs, LidarPairStream
from coec.service.engine.rig import RigEstimator, RigSnapshot
from coec.service.engine.vehicle import Vehicle
from coec.service.ingest.decoder import CAMERA, EGO, LIDAR
from coec.service.ingest.pair_stream import frame_bytes
from coec.service.process_lifetime import joined
from coec.service.recording.recorder import RecordBetween, RecordingThread, RecordPair
from coec.service.recording.window_store import WindowStore
from coec.service.records.pair_store import PairRecords
from coec.service.records.state_store import StateStore
from coec.service.timing import Clock
from coec.service.vehicle_context import VehicleContext
from coec.service.worker.supervisor import Worker, WorkerState
from coec.service.worker.worker_jobs import JobOutcome, Kind, WorkerJob

POLL_S = 0.02
"""Longest wait for a worker or the disk before events are looked for again, s."""

START_S = 600.0
"""Longest start of a worker: the first on a machine compiles kernels."""

ATTEMPTS = 3
"""How many workers may fail to start before the replay is given up."""

STOP_S = 5.0

READ_AHEAD_BYTES = 2**29
"""Frames that may be read before the engine takes them, bytes: those of twenty seconds of a LiDAR of 64 beams, which
are read while the engine waits for a window."""

MOST_CORES = 64.0
"""Budget of a replay: what work costs does not decide what is checked."""


MOST_THREADS = 16
"""Threads of a worker, if the machine has so many cores: the result does not depend on their number."""


StreamFrame = tuple[str, Frame]
"""A frame, and the number of its stream."""


def read_ahead(frames: Iterator[StreamFrame], max_bytes: int) -> Iterator[StreamFrame]:
    """The same frames, read on a thread of their own while earlier ones are used. Up to `max_bytes` of them wait."""
    condition = threading.Condition()
    waiting: deque[tuple[StreamFrame | Exception | None, int]] = deque()
    waiting_bytes, is_open = 0, True

    def put(item: StreamFrame | Exception | None) -> bool:
        nonlocal waiting_bytes
        size = frame_bytes(item[1]) if isinstance(item, tuple) else 0
        with condition:
            condition.wait_for(lambda: not is_open or not waiting or waiting_bytes + size <= max_bytes)
            waiting.append((item, size))
            waiting_bytes += size
            condition.notify_all()
            return is_open

    def read() -> None:
        try:
            if all(put(frame) for frame in frames):
                put(None)
        except Exception as error:
            put(error)

    thread = threading.Thread(target=read, name="reader", daemon=True)
    thread.start()
    try:
        while True:
            with condition:
                condition.wait_for(lambda: waiting)
                item, size = waiting.popleft()
                waiting_bytes -= size
                condition.notify_all()
            if item is None:
                return
            if isinstance(item, Exception):
                raise item
            yield item
    finally:
        with condition:
            is_open = False
            condition.notify_all()
        thread.join()


class DriveClock(Clock):
    """Shows the sensor time of the drive."""

    def __init__(self, stamp_ns: int) -> None:
        self.stamp_ns = stamp_ns

    def monotonic_s(self) -> float:
        """Sensor time, s."""
        return self.stamp_ns / NS_PER_S

    def wall_ns(self) -> int:
        """Sensor time, ns."""
        return self.stamp_ns


class _ReplayVehicle(Vehicle):
    """Keeps outcomes until the drive has come to their sensor time."""

    def __init__(self, config: Config, rig: RigEstimator, clock: DriveClock) -> None:
        super().__init__(config.limits, Budget(config.budget, clock.monotonic_s), rig, lambda _: None, clock=clock)
        self._outcomes: queue.SimpleQueue[tuple[str, messages.JobSubject, JobOutcome]] = queue.SimpleQueue()
        self._arrived: list[tuple[str, messages.JobSubject, JobOutcome]] = []

    def post_outcome(self, receiver: str, subject: messages.JobSubject, outcome: JobOutcome) -> None:
        """Called on the thread of a worker."""
        self._outcomes.put((receiver, subject, outcome))

    def deliver(self, requested: messages.JobSubject) -> None:
        """Posts the outcome about `requested` if it has come; waits up to `POLL_S` for any."""
        with suppress(queue.Empty):
            if not any(subject == requested for _, subject, _ in self._arrived):
                self._arrived.append(self._outcomes.get(timeout=POLL_S))
        for arrived in self._arrived:
            if arrived[1] == requested:
                self._arrived.remove(arrived)
                super().post_outcome(*arrived)
                return


class _ReplayWorkers:
    """One or more worker processes in place of the one of the service: the first solves, the last checks."""

    warms_up = False
    compiled_s = 0.0

    def __init__(self, config: Config, number: int) -> None:
        self._workers = [Worker(config.worker, config.model_dump_json()) for _ in range(number)]

    @contextmanager
    def running(self) -> Iterator[None]:
        """The processes are ready for jobs.

        Raises:
            SourceError: a worker cannot be used.
        """
        for worker in self._workers:
            worker.start()
        try:
            end_s = time.monotonic() + START_S
            for worker in self._workers:
                while worker.warms_up or (status := worker.status()).state is WorkerState.STARTING:
                    reason = worker.unusable or (status.failure if status.starts > ATTEMPTS else None)
                    if reason is not None or time.monotonic() > end_s:
                        raise SourceError("No worker became ready in time." if reason is None else reason.text)
                    time.sleep(POLL_S)
            yield
        finally:
            for worker in self._workers:
                worker.request_stop()
            joined([worker.thread for worker in self._workers], STOP_S)

    def submit(self, job: WorkerJob) -> None:
        """Has a job done."""
        self._workers[-1 if job.kind is Kind.CHECK else 0].submit(job)

    def prefetch(self, pair: str, frame: bytes) -> None:
        """Announces that the depth of a frame will be needed by the next window."""
        self._workers[0].prefetch(pair, frame)

    def commissioning(self, pair: str) -> str | None:
        """No rig is commissioned in a replay."""
        del pair
        return None


class _ReplayedPair(CameraLidarPair):
    """Notes every step that does something."""

    def __init__(self, pair: PairConfig, config: Config, context: VehicleContext) -> None:
        self.transitions: list[Transition] = []
        super().__init__(pair, config, context)

    @property
    def oldest_request(self) -> messages.PairRequest | None:
        """The request whose result is to be concluded next; None if there is none."""
        return self.engine.oldest_request

    @property
    def is_waiting(self) -> bool:
        """Whether a frame pair cannot be evaluated until a result, or the rig, has come as far."""
        return bool(self.stream.held.pairs) and self.engine.is_waiting

    def _step(self, event: messages.Event) -> None:
        before = self.engine.store.state.health.value
        actions = self.engine.step(event)
        health = (before, self.engine.store.state.health.value)
        idle = (
            not actions
            if isinstance(event, messages.SensorTime | messages.Evaluate)
            else isinstance(event, messages.Tick)
        )
        if not idle or health[0] != health[1]:
            stamp_ns = self._context.vehicle.clock.wall_ns()
            self.transitions.append(Transition(stamp_ns, _event_text(event), tuple(_action_texts(actions)), health))
        self._do(action for action in actions if not isinstance(action, messages.Publish))  # nobody queries a replay

    def end_slice(self) -> None:
        """Sensor time has come to the end of the open slice."""
        end_ns = self.engine.selector.slice_end_ns
        if end_ns is not None:
            self._step(messages.SensorTime(end_ns))


class DriveReplay:
    """The replay of one drive, with all pairs of a configuration as one rig, in a state directory of its own."""

    def __init__(self, config: Config, folder: Path, first_ns: int, workers: int) -> None:
        """`first_ns`: stamp of the first frame. `workers`: number of worker processes.

        Raises:
            ConfigError, RecordingError: the rig cannot be built, or the folder cannot be used.
        """
        state = config.state.model_copy(
            update={"directory": folder, "history": MOST_ENTRIES, "checks": MOST_CHECKS, "min_free_bytes": 0}
        )
        log = config.log.model_copy(update={"level": "warning"})
        threads = max(config.worker.threads, min(MOST_THREADS, len(os.sched_getaffinity(0))))
        worker = config.worker.model_copy(update={"niceness": 0, "threads": threads})
        budget = BudgetConfig(cores=MOST_CORES)
        config = config.model_copy(update={"state": state, "budget": budget, "log": log, "worker": worker})
        self._clock = DriveClock(first_ns)
        self._workers = _ReplayWorkers(config, workers)
        self._disk_writer = DiskWriter(folder)
        self._recording = RecordingThread()
        windows = WindowStore(folder / "windows", state)
        self._vehicle = _ReplayVehicle(config, RigEstimator(folder, config.links, self._disk_writer), self._clock)
        workers_in_place = cast("Worker", self._workers)
        context = VehicleContext(
            keys=Keys(config.prefix, config.vehicle),
            vehicle=self._vehicle,
            store=StateStore(folder, config.vehicle),
            disk_writer=self._disk_writer,
            folder=windows,
            recording=self._recording,
            worker=workers_in_place,
            publish=lambda *_: None,
            vehicle_problems=tuple,
            show=lambda *_: None,
            topics=RosTopicList,
        )
        self._pairs = [_ReplayedPair(pair, config, context) for pair in config.pairs]
        lidars = LidarPairs(config.lidar_edges, self._vehicle, workers_in_place)
        lidars.grow(config.pairs)
        self._numbers: dict[str, dict[str, str]] = {}
        for pair in self._pairs:
            known = {number for of_pair in self._numbers.values() for number in of_pair.values()}
            self._numbers[pair.name] = {
                kind: sensor.number for kind, sensor in pair.sensors.items() if sensor.number not in known
            }
        self._receivers: tuple[_ReplayedPair | LidarPairStream, ...] = (*self._pairs, *lidars.streams)

    @property
    def rig(self) -> RigSnapshot:
        """What is known of the rig."""
        return self._vehicle.rig.snapshot

    @property
    def kinds(self) -> dict[str, tuple[str, ...]]:
        """By the name of each pair, the kinds of frames (see `Recording.messages`) that it has to provide: those of a
        sensor of several pairs come from the first."""
        of_stream = {CAMERA: IMAGE, LIDAR: CLOUD, EGO: MOTION}
        return {pair: tuple(of_stream[kind] for kind in numbers) for pair, numbers in self._numbers.items()}

    def run(self, frames: Mapping[str, Iterator[Frame]], on_frame: Callable[[int], None]) -> dict[str, ReplayedDrive]:
        """Has the engine take all frames, given in ascending order by the names of the pairs; others than those of
        `kinds` are left out. `on_frame(stamp_ns)` is called for each image.

        Returns:
            By the names of the pairs.

        Raises:
            SourceError: a worker cannot be used, or a frame cannot be read.
        """
        begin_ns = self._clock.stamp_ns
        with self._running(), self._workers.running():
            started_s = time.monotonic()
            for number, frame in read_ahead(self._merged(frames), READ_AHEAD_BYTES):
                self._clock.stamp_ns = max(self._clock.stamp_ns, frame.stamp_ns)
                self._vehicle.inbox.put(number, InputSample(b"", MSGPACK, frame=frame))
                self._settle()
                if isinstance(frame, CameraFrame):
                    on_frame(frame.stamp_ns)
            end_ns = self._clock.stamp_ns
            healths = [pair.engine.store.state.health.value for pair in self._pairs]
            self._finish()
            elapsed_s = time.monotonic() - started_s
        return {
            pair.name: ReplayedDrive(
                decisions_of(PairRecords(pair.engine.store.history.entries(), pair.engine.store.checks(), ())),
                tuple(pair.transitions),
                pair.stream.losses(),
                health,
                begin_ns,
                end_ns,
                elapsed_s,
            )
            for pair, health in zip(self._pairs, healths, strict=True)
        }

    def _merged(self, frames: Mapping[str, Iterator[Frame]]) -> Iterator[StreamFrame]:
        """All frames in the order of their stamps, each stream once."""
        numbered = (_numbered(frames[pair], numbers) for pair, numbers in self._numbers.items())
        return heapq.merge(*numbered, key=lambda entry: entry[1].stamp_ns)

    @contextmanager
    def _running(self) -> Iterator[None]:
        """The threads of the disk run."""
        self._recording.thread.start()
        self._disk_writer.thread.start()
        try:
            yield
        finally:
            self._recording.request_stop()
            self._disk_writer.request_stop()
            joined([self._recording.thread, self._disk_writer.thread], STOP_S)
        for thread in (self._recording.thread, self._disk_writer.thread):
            if thread.failure is not None:
                raise SourceError(f"The thread {thread.name} died: {thread.failure!r}.")

    def _settle(self) -> None:
        """Has the engine do all that it may, and waits for the results that it waits for. What then waits for frames of
        another pair is left."""
        while True:
            self._vehicle.turn(0.0)
            if self._vehicle.is_busy:
                continue
            if any(receiver.is_waiting and receiver.oldest_request is not None for receiver in self._receivers):
                self._deliver_oldest(blocking_only=True)
            elif any(pair.stream.held.pairs and not pair.recorder.has_room for pair in self._pairs):
                time.sleep(POLL_S)  # the disk is slower than the replay
            else:
                return

    def _finish(self) -> None:
        """The drive has ended: takes all results, and ends the open slices at their ends, as silence would in the
        service."""
        for pair in self._pairs:
            pair.stream.flush(self._clock.monotonic_s())
        self._settle()
        for pair in self._pairs:
            pair.finish_pairs()  # which waited for pairs that have ended
        while any(receiver.oldest_request is not None for receiver in self._receivers) or any(
            pair.engine.selector.slice_end_ns is not None for pair in self._pairs
        ):
            for pair in self._pairs:
                pair.end_slice()
            self._deliver_oldest(blocking_only=False)
            self._settle()
        self._vehicle.finish()

    def _deliver_oldest(self, *, blocking_only: bool) -> None:
        """Waits for the result that counts first, of those that a receiver waits for or of all."""
        requests = [
            receiver.oldest_request
            for receiver in self._receivers
            if receiver.oldest_request is not None and (receiver.is_waiting or not blocking_only)
        ]
        if requests:
            request = min(requests, key=lambda one: one.due_ns)
            self._vehicle.deliver(request.subject if isinstance(request.subject, messages.WindowSubject) else request)


def _numbered(frames: Iterator[Frame], numbers: Mapping[str, str]) -> Iterator[StreamFrame]:
    return ((numbers[stream_of(frame)], frame) for frame in frames if stream_of(frame) in numbers)


def _event_text(event: messages.Event) -> str:
    match event:
        case messages.Evaluate():
            return "frame pair"
        case messages.JobDone(subject=messages.WindowSubject() as subject):
            return f"window {subject.window_id} solved: {event.outcome.fate.value}"
        case messages.JobDone():
            return f"job ended: {event.outcome.fate.value}"
        case _:
            return _type_label(event)


def _type_label(value: object) -> str:
    """The name of a type in words: `RecordPair` is `record pair`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(value).__name__).lower()


def _action_texts(actions: Sequence[messages.Action]) -> Iterator[str]:
    for action in actions:
        match action:
            case RecordPair() | RecordBetween():
                yield f"{_type_label(action)} for {action.window_id}"
            case SliceClosed():
                yield f"end of {action.window_id} with {count(action.pairs, 'pair')}"
            case messages.SubmitCheck():
                yield f"check of {count(len(action.pairs), 'pair')}, counts from {action.request.due_ns} ns"
            case _:
                yield _type_label(action)
