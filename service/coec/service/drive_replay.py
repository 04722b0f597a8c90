"""Replays a recorded drive through the engine of the service: which checks and windows it makes of it, what it serves,
and when.

The engine is that of the service; no thread runs it. The sensor time of the frames is the clock, so no frame is dropped
and no time passes while a job runs. A result is handed to the engine when the drive has come to the sensor time from
which it counts, so two replays are equal to the byte whatever the machine does. Meanwhile jobs run on worker processes,
and a thread reads ahead. The engine takes the frames as they were read, and checks them as if they were messages.
"""

from __future__ import annotations

import os
import queue
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import cast

from coec.calibration.frames.window import SliceClosed
from coec.calibration.types import NS_PER_S, CameraFrame, Frame
from coec.config import BudgetConfig, Config, PairConfig
from coec.errors import SourceError
from coec.io.disk_writer import DiskWriter
from coec.io.zenoh.bus import MSGPACK, InputSample
from coec.io.zenoh.player import stream_of
from coec.io.zenoh.ros_node import RosTopicList
from coec.reports.formatting import count
from coec.schemas.keys import Keys
from coec.service.camera_lidar_pair import CameraLidarPair
from coec.service.cpu_budget import Budget
from coec.service.decision_log import MOST_CHECKS, MOST_ENTRIES, ReplayedDrive, Transition, decisions_of
from coec.service.engine import messages
from coec.service.engine.rig import RigEstimator
from coec.service.engine.vehicle import Vehicle
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


def read_ahead(frames: Iterator[Frame], max_bytes: int) -> Iterator[Frame]:
    """The same frames, read on a thread of their own while earlier ones are used. Up to `max_bytes` of them wait."""
    condition = threading.Condition()
    waiting: deque[tuple[Frame | Exception | None, int]] = deque()
    waiting_bytes, is_open = 0, True

    def put(item: Frame | Exception | None) -> bool:
        nonlocal waiting_bytes
        size = 0 if item is None or isinstance(item, Exception) else frame_bytes(item)
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
    """The replay of one drive of one pair, in a state directory of its own."""

    def __init__(self, config: Config, folder: Path, first_ns: int, workers: int) -> None:
        """`config` has one pair. `first_ns`: stamp of the first frame. `workers`: number of worker processes.

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
        self._vehicle = _ReplayVehicle(config, RigEstimator(folder, (), self._disk_writer), self._clock)
        context = VehicleContext(
            keys=Keys(config.prefix, config.vehicle),
            vehicle=self._vehicle,
            store=StateStore(folder, config.vehicle),
            disk_writer=self._disk_writer,
            folder=windows,
            recording=self._recording,
            worker=cast("Worker", self._workers),
            publish=lambda *_: None,
            vehicle_problems=tuple,
            show=lambda *_: None,
            topics=RosTopicList,
        )
        self._pair = _ReplayedPair(config.pairs[0], config, context)

    def run(self, frames: Iterator[Frame], on_frame: Callable[[int], None]) -> ReplayedDrive:
        """Has the engine take all frames. `on_frame(stamp_ns)` is called for each image.

        Raises:
            SourceError: a worker cannot be used, or a frame cannot be read.
        """
        begin_ns = self._clock.stamp_ns
        with self._running(), self._workers.running():
            started_s = time.monotonic()
            for frame in read_ahead(frames, READ_AHEAD_BYTES):
                self._clock.stamp_ns = max(self._clock.stamp_ns, frame.stamp_ns)
                sensor = self._pair.sensors.get(stream_of(frame))
                if sensor is not None:
                    self._vehicle.inbox.put(sensor.number, InputSample(b"", MSGPACK, frame=frame))
                self._settle()
                if isinstance(frame, CameraFrame):
                    on_frame(frame.stamp_ns)
            end_ns, health = self._clock.stamp_ns, self._pair.engine.store.state.health.value
            self._finish()
            elapsed_s = time.monotonic() - started_s
        store = self._pair.engine.store
        return ReplayedDrive(
            decisions_of(PairRecords(store.history.entries(), store.checks(), ())),
            tuple(self._pair.transitions),
            self._pair.stream.losses(),
            health,
            begin_ns,
            end_ns,
            elapsed_s,
        )

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
        """Has the engine do all that it may, and waits for the results that it waits for."""
        pair = self._pair
        while self._vehicle.turn(0.0) or pair.stream.held.pairs:
            if not pair.stream.held.pairs:
                continue
            if pair.engine.oldest_request is not None and pair.engine.is_waiting:
                self._deliver_oldest(pair.engine.oldest_request)
            elif not pair.recorder.has_room:
                time.sleep(POLL_S)  # the disk is slower than the replay

    def _finish(self) -> None:
        """The drive has ended: takes all results, and ends the open slice at its end, as silence would in the
        service."""
        pair = self._pair
        pair.stream.flush(self._clock.monotonic_s())
        self._settle()
        while pair.engine.oldest_request is not None or pair.engine.selector.slice_end_ns is not None:
            pair.end_slice()
            if pair.engine.oldest_request is not None:
                self._deliver_oldest(pair.engine.oldest_request)
            self._settle()

    def _deliver_oldest(self, request: messages.PairRequest) -> None:
        self._vehicle.deliver(request.subject if isinstance(request.subject, messages.WindowSubject) else request)


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
