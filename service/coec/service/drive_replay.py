"""Replays a recorded drive through the engine of the service: which checks and windows it makes of it, what it serves,
and when; what it decided in the order of sensor time, how two such logs differ, and both for people to read.

A log is made of the records of a pair: every check, every window's estimate, every extrinsic that was served, every
state of health. It has one JSON object a line. States that the steady clock alone brings about, such as a check that is
overdue, have no sensor time and depend on the machine; a log leaves them out, and the return from them.

The engine is that of the service; no thread runs it. The sensor time of the frames is the clock, so no frame is dropped
and no time passes while a job runs. A result is handed to the engine when the drive has come to the sensor time from
which it counts, so two replays are equal to the byte whatever the machine does. Jobs run on worker processes meanwhile.
"""

from __future__ import annotations

import json
import queue
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

from coec.calibration.frames.window import SliceClosed
from coec.calibration.types import Frame
from coec.config import BudgetConfig, Config, PairConfig
from coec.errors import SourceError, UsageError
from coec.io.disk_writer import DiskWriter
from coec.io.msgpack_frames import encode
from coec.io.zenoh.bus import MSGPACK, InputSample
from coec.io.zenoh.player import stream_of
from coec.io.zenoh.ros_node import RosTopicList
from coec.reports.formatting import count
from coec.reports.page import Facts, Page, Section, Table, Text, write
from coec.schemas.keys import Keys
from coec.service.camera_lidar_pair import CameraLidarPair
from coec.service.cpu_budget import Budget
from coec.service.engine import messages
from coec.service.engine.rig import RigEstimator
from coec.service.engine.vehicle import Vehicle
from coec.service.process_lifetime import joined
from coec.service.recording.recorder import RecordBetween, RecordingThread, RecordPair
from coec.service.recording.window_store import WindowStore
from coec.service.records.history import CheckLog, PairHistory
from coec.service.records.pair_store import PairRecords
from coec.service.records.state_store import StateStore
from coec.service.timing import NS_PER_S, Clock
from coec.service.vehicle_context import VehicleContext
from coec.service.worker.supervisor import Worker, WorkerState
from coec.service.worker.worker_jobs import JobOutcome, Kind, WorkerJob

KINDS = ("check", "estimate", "extrinsic", "state")
"""Of decisions, in the order in which those of one stamp are listed."""

MOST_ENTRIES, MOST_CHECKS = 10_000, 100_000
"""Entries of the history, and checks, of a log: as many as a service can keep."""

MOST_BYTES = 2**28
"""Largest log that is read."""


@dataclass(frozen=True, slots=True)
class Decision:
    """One decision.

    Attributes:
        kind: one of `KINDS`.
        stamp_ns: sensor time of the data behind it.
        name: what it is about: id of the window, outcome of the checks, provenance of the extrinsic, state.
        values: everything that is compared.
    """

    kind: str
    stamp_ns: int
    name: str
    values: dict[str, Any]

    def line(self) -> str:
        """As a line of a log."""
        document = {"kind": self.kind, "stamp_ns": self.stamp_ns, "name": self.name, "values": self.values}
        return json.dumps(document, sort_keys=True, separators=(",", ":"))


def decisions_of(records: PairRecords) -> tuple[Decision, ...]:
    """The decisions in the records of a pair."""
    return tuple(sorted(_decisions(records), key=lambda one: (one.stamp_ns, KINDS.index(one.kind))))


def _decisions(records: PairRecords) -> Iterator[Decision]:
    for check in records.checks:
        values = check.model_dump(mode="json", exclude={"state"})
        yield Decision("check", check.stamp_ns, check.outcome, values)
    state = ""
    for record in records.entries:
        entry = record.entry
        if entry.stamp_ns is None or (entry.kind == "state" and entry.code == state):
            continue
        state = entry.code if entry.kind == "state" else state
        if record.result is not None:
            yield Decision("estimate", entry.stamp_ns, entry.code, record.result.model_dump(mode="json"))
        elif entry.kind in ("extrinsic", "state"):
            pose = None if entry.camera_from_lidar is None else entry.camera_from_lidar.model_dump(mode="json")
            values = {"code": entry.code, "window_id": entry.window_id, "camera_from_lidar": pose}
            yield Decision(entry.kind, entry.stamp_ns, entry.code, values)


def read_log(path: Path, pair: str) -> tuple[Decision, ...]:
    """The decisions in a log, or in the state directory of a service.

    Raises:
        SourceError: there is no such file, or it is neither.
    """
    if path.is_dir():
        return _of_state_directory(path, pair)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise SourceError(f"{path} is larger than {MOST_BYTES / 1e6:.0f} MB: it is no log of decisions")
        documents = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return tuple(
            Decision(str(one["kind"]), int(one["stamp_ns"]), str(one["name"]), dict(one["values"])) for one in documents
        )
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise SourceError(f"{path} is no log of decisions: write one with `coec replay DRIVE --log FILE`") from error


def _of_state_directory(folder: Path, pair: str) -> tuple[Decision, ...]:
    """Reads copies of the files, because damaged ones are set aside when they are opened."""
    with TemporaryDirectory() as copies:
        try:
            for file in folder.glob(f"*-{pair}.jsonl"):
                if file.stat().st_size > MOST_BYTES:
                    raise SourceError(f"{file} is larger than {MOST_BYTES / 1e6:.0f} MB")
                shutil.copyfile(file, Path(copies) / file.name)
        except OSError as error:
            raise SourceError(f"{folder} cannot be read: {error.strerror}") from error
        history = PairHistory(Path(copies), pair, MOST_ENTRIES, {})
        checks = CheckLog(Path(copies) / f"checks-{pair}.jsonl", MOST_CHECKS)
        decisions = decisions_of(PairRecords(history.entries(), checks.checks(), ()))
    if not decisions:
        others = sorted(file.stem.removeprefix("checks-") for file in folder.glob("checks-*.jsonl"))
        hint = f"; it has those of {', '.join(others)}: give the service's --config" if others else ""
        raise SourceError(f"{folder} holds no records of a pair {pair}{hint}")
    return decisions


def write_log(path: Path, decisions: Iterable[Decision]) -> None:
    """Writes a log.

    Raises:
        UsageError: the file cannot be written.
    """
    try:
        path.write_text("".join(f"{one.line()}\n" for one in decisions), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror}") from error


@dataclass(frozen=True, slots=True)
class Difference:
    """A decision that differs. `before`, `after`: None if there is none of this kind at this sensor time. `fields`:
    places of the values that differ."""

    before: Decision | None
    after: Decision | None
    fields: tuple[str, ...] = ()

    @property
    def either(self) -> Decision:
        """The decision, of whichever log has it."""
        decision = self.after or self.before
        assert decision is not None
        return decision


def differences(before: Sequence[Decision], after: Sequence[Decision]) -> tuple[Difference, ...]:
    """What differs between two logs, in the order of sensor time. Decisions of one kind and stamp belong together."""
    keyed_before, keyed_after = _keyed(before), _keyed(after)
    result = []
    for key in sorted(keyed_before.keys() | keyed_after.keys()):
        one, other = keyed_before.get(key), keyed_after.get(key)
        if one is None or other is None:
            result.append(Difference(one, other))
        elif one.values != other.values:
            places = (place.partition("[")[0] for place, _, _ in value_differences(one.values, other.values))
            result.append(Difference(one, other, tuple(dict.fromkeys(places))))
    return tuple(result)


def _keyed(decisions: Sequence[Decision]) -> dict[tuple[int, int, int], Decision]:
    """By stamp, kind, and number among those of one stamp and kind."""
    keyed: dict[tuple[int, int, int], Decision] = {}
    for decision in decisions:
        kind = KINDS.index(decision.kind) if decision.kind in KINDS else len(KINDS)
        number = 0
        while (decision.stamp_ns, kind, number) in keyed:
            number += 1
        keyed[decision.stamp_ns, kind, number] = decision
    return keyed


def value_differences(before: Any, after: Any, at: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(place, before, after) of every value that differs between two documents."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted(before.keys() | after.keys()):
            yield from value_differences(before.get(key), after.get(key), f"{at}.{key}" if at else str(key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for index, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from value_differences(one, other, f"{at}[{index}]")
    elif before != after:
        yield at, before, after


# --- the replay -------------------------------------------------------------------------------------------------------

POLL_S = 0.02
"""Longest wait for a worker or the disk before events are looked for again, s."""

START_S = 600.0
"""Longest start of a worker: the first on a machine compiles kernels."""

ATTEMPTS = 3
"""How many workers may fail to start before the replay is given up."""

STOP_S = 5.0

MOST_CORES = 64.0
"""Budget of a replay: what work costs does not decide what is checked."""


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


@dataclass(frozen=True, slots=True)
class Transition:
    """A step of the engine that did something. It is text, because the frames of its event must not stay in memory.

    Attributes:
        stamp_ns: sensor time of the drive.
        event, actions: what came, and what it led to.
        health: states of health before and after it.
    """

    stamp_ns: int
    event: str
    actions: tuple[str, ...]
    health: tuple[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedDrive:
    """What the engine made of a drive.

    Attributes:
        decisions: in the order of sensor time.
        transitions: steps of the engine, in their order.
        losses: by place and cause.
        health: state of health at the end of the drive.
        begin_ns, end_ns: stamps of the first and the last frame.
        elapsed_s: time of the replay without the start of the workers, s.
    """

    decisions: tuple[Decision, ...]
    transitions: tuple[Transition, ...]
    losses: dict[tuple[str, str], int]
    health: str
    begin_ns: int
    end_ns: int
    elapsed_s: float

    @property
    def driven_s(self) -> float:
        """Length of the drive, s."""
        return (self.end_ns - self.begin_ns) / NS_PER_S


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
    """Worker processes in place of the one of the service: the first solves, the last checks."""

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
        self._do(actions)

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
        config = config.model_copy(update={"state": state, "budget": BudgetConfig(cores=MOST_CORES), "log": log})
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
        """Has the engine take all frames. `on_frame(stamp_ns)` is called for each.

        Raises:
            SourceError: a worker cannot be used, or a frame cannot be read.
        """
        begin_ns = self._clock.stamp_ns
        with self._running(), self._workers.running():
            started_s = time.monotonic()
            for frame in frames:
                self._clock.stamp_ns = max(self._clock.stamp_ns, frame.stamp_ns)
                sensor = self._pair.sensors.get(stream_of(frame))
                if sensor is not None:
                    self._vehicle.inbox.put(sensor.number, InputSample(encode(frame), MSGPACK))
                self._settle()
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


# --- for people -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class OutlineLine:
    """A decision as a line; `time` is in seconds of the drive."""

    time: str
    kind: str
    name: str
    text: str


def outline(decisions: Sequence[Decision], first_ns: int) -> Iterator[OutlineLine]:
    """The decisions of a drive that begins at `first_ns`; checks that say what the one before them said are counted."""
    before, repeated = "", 0
    for decision in decisions:
        if decision.kind == "check" and decision.name == before:
            repeated += 1
            continue
        if repeated:
            yield OutlineLine("", "check", before, f"{count(repeated, 'more check')}")
            repeated = 0
        before = decision.name if decision.kind == "check" else before
        seconds = f"{(decision.stamp_ns - first_ns) / NS_PER_S:.1f}"
        yield OutlineLine(seconds, decision.kind, decision.name, _text(decision))
    if repeated:
        yield OutlineLine("", "check", before, f"{count(repeated, 'more check')}")


def _text(decision: Decision) -> str:
    values = decision.values
    match decision.kind:
        case "check":
            return f"evidence {values['evidence']:.1f}, {'flagged' if values['flagged'] else 'not flagged'}"
        case "estimate":
            sigma = [value for value in values["sigma"][:3] if value is not None]
            reasons = " ".join(reason["text"] for reason in values["verdict"]["reasons"])
            text = f"{values['window_id']}, {values['pairs']} pairs"
            return f"{text}, σ {max(sigma):.2f}°. {reasons}" if sigma else f"{text}. {reasons}"
        case "extrinsic":
            return "" if values["window_id"] is None else f"by {values['window_id']}"
        case _:
            return ""


def write_replay_page(
    path: Path, name: str, replayed: ReplayedDrive, first_ns: int, differing: Sequence[Difference] | None
) -> None:
    """Writes a page with the decisions of a drive and, if they were compared, what differs.

    Raises:
        RecordingError: the file cannot be written.
    """
    rows = [(line.time, line.kind, line.name, line.text) for line in outline(replayed.decisions, first_ns)]
    sections = [
        Section("Decisions", (Table("In the order of sensor time.", HEADS, rows, frozenset({0}), frozenset({3})),))
    ]
    if differing is not None:
        sections.insert(0, Section("Differences", (_differences(differing, first_ns),)))
    losses = tuple((f"{place}, {cause}", str(number)) for (place, cause), number in sorted(replayed.losses.items()))
    if losses:
        sections.append(Section("Losses", (Facts(losses),)))
    facts = Facts(
        (
            ("Length of the drive", f"{replayed.driven_s:.0f} s"),
            ("Health at the end", replayed.health),
            ("Checks", str(sum(one.kind == "check" for one in replayed.decisions))),
            ("Windows", str(sum(one.kind == "estimate" for one in replayed.decisions))),
        )
    )
    write(path, Page("Replay of a drive", name, (facts,), tuple(sections)))


HEADS = ("Time, s", "Decision", "Outcome", "Details")


def _differences(differing: Sequence[Difference], first_ns: int) -> Table | Text:
    if not differing:
        return Text(("The decisions are equal.",))
    rows = [
        (
            f"{(one.either.stamp_ns - first_ns) / NS_PER_S:.1f}",
            one.either.kind,
            "none" if one.before is None else one.before.name,
            "none" if one.after is None else one.after.name,
            ", ".join(one.fields),
        )
        for one in differing
    ]
    heads = ("Time, s", "Decision", "There", "Here", "Values that differ")
    return Table("Decisions that differ.", heads, rows, frozenset({0}), frozenset({4}))
