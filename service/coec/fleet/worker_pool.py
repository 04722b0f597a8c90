"""Distributes windows over worker processes, wherever they run. `Engine` is the interface of what evaluates a batch;
`WorkerPool` does the work of every engine.

A process gets windows when it has started, never before: one that no machine has room for holds none back. A window
counts as tried only if it was with a process that ran. What a process does to its windows, and what is done about it:

| the process | its windows |
|---|---|
| ended, or exceeded a bound | each is tried once more, alone; the second end is a row with an error |
| was lost with its machine | are evaluated by others; the third loss is a row with an error |
| failed several times in succession for a common cause | are evaluated by others; this process gets no more |
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from coec.errors import CoecError, ModelError
from coec.fleet.evaluator import ReplaySettings
from coec.fleet.jobs import Job, StoreError, lost_row
from coec.schemas.documents import WindowRow

PROCESS_DIED, DEADLINE, TOO_LARGE = "process_died", "deadline", "memory_exceeded"
"""Error codes of windows whose process ended or was ended."""

NODE_LOST = "node_lost"
"""Error code of a window that was with several machines, each of which was lost."""

NOT_ON_NODE = "not_on_node"
"""Error code of a window whose path exists on this machine, but not on the one that should judge it."""

COMMON_CAUSES: Mapping[str, str] = {
    StoreError.reply_code: "check the credentials, the address and the client package of the store",
    ModelError.reply_code: "install the file of the depth network at this path on every machine that judges windows, "
    "or name another network with --depth",
    NOT_ON_NODE: "use a folder that every node mounts at the same path, or URLs of a store",
}
"""Error codes whose cause is not the window, with what to do. Every other window on that machine fails in the same
way."""


class FleetError(CoecError):
    """A batch that cannot go on."""

    reply_code = "batch_failed"


@dataclass(frozen=True, slots=True)
class WorkerLimits:
    """Limits for the work on one window, and for failures.

    Attributes:
        seconds: longest wall time without a word of the process that has the window.
        bytes: largest memory of that process.
        alike: a process that fails with a common cause (`COMMON_CAUSES`) so many times in succession gets no more
            windows; None: such a failure is a row like any other.
    """

    seconds: float
    bytes: int
    alike: int | None = 3

    @property
    def deadline_message(self) -> str:
        """The error text for a window that took longer."""
        return f"it was not judged within {self.seconds:g} s (--deadline)"


class Engine(Protocol):
    """Judges windows on the same terms."""

    @property
    def cores(self) -> int:
        """How many windows are solved at a time."""

    def rows(self, jobs: Sequence[Job], settings: ReplaySettings) -> Iterator[WindowRow]:
        """A row for every window, as they are finished. A window that ends its process gets a row, too.

        Raises:
            FleetError: the engine itself fails, or windows could not be judged for a common cause. Those have no row.
        """

    def close(self) -> None:
        """Releases what the engine holds beside its processes; it is not used again."""


WINDOWS_PER_WORKER = 2
"""How many windows a process has at a time: one that it solves, and one that it fetches meanwhile."""

MAX_LOSSES = 3
"""How many machines may be lost while they have a window. A window that exhausts a machine could end every one."""

MAX_TRIES = 2
"""How often a window is tried that fails for a common cause: a store may have been away for a moment."""


class WindowQueue:
    """The waiting windows. A window whose process ended is tried once more, alone in a process. The first end may have
    been caused by another window, or by memory that others had taken; the second one is caused by this window."""

    def __init__(self, jobs: Iterable[Job]) -> None:
        self._waiting = deque(jobs)
        self._suspected: set[Job] = set()
        self._losses: Counter[Job] = Counter()
        self._tries: Counter[Job] = Counter()
        self._unjudged = 0

    def __bool__(self) -> bool:
        """Whether windows wait."""
        return bool(self._waiting)

    @property
    def unjudged(self) -> int:
        """How many windows failed for a common cause as often as they are tried."""
        return self._unjudged

    def next_for(self, assigned: Collection[Job]) -> Job | None:
        """The next window for a process that has these; None: it gets no more now."""
        if not self._waiting or len(assigned) >= WINDOWS_PER_WORKER:
            return None
        if assigned and (self._waiting[0] in self._suspected or not self._suspected.isdisjoint(assigned)):
            return None
        return self._waiting.popleft()

    def retry_alone(self, assigned: Collection[Job], code: str, text: str) -> Iterator[WindowRow]:
        """A process with these windows has ended, for a reason. Queues the windows again, and returns the rows of those
        that are not tried again."""
        for job in reversed(list(assigned)):
            if job in self._suspected:
                yield lost_row(job, code, text)
            else:
                self._suspected.add(job)
                self._waiting.appendleft(job)

    def requeue(self, assigned: Collection[Job]) -> None:
        """Queues windows again, before all others, that a process had but has not finished through no fault of theirs.
        Nothing is remembered about them."""
        self._waiting.extendleft(reversed(list(assigned)))

    def requeue_lost(self, assigned: Collection[Job], text: str) -> Iterator[WindowRow]:
        """The machine with these windows was lost, which is hardly their fault. Queues them again before all others,
        and returns the rows of those that have been lost too often."""
        for job in reversed(list(assigned)):
            self._losses[job] += 1
            if self._losses[job] >= MAX_LOSSES:
                yield lost_row(job, NODE_LOST, f"{text}, as were {MAX_LOSSES - 1} machines that had it before")
            else:
                self._waiting.appendleft(job)

    def postpone(self, job: Job) -> None:
        """A window failed for a common cause. It is tried again after all others, `MAX_TRIES` times in all."""
        self._tries[job] += 1
        if self._tries[job] < MAX_TRIES:
            self._waiting.append(job)
        else:
            self._unjudged += 1


_log = logging.getLogger(__name__)

POLL_S = 0.5
"""Longest wait for an event of a process, s."""

START_S = 300.0
"""Longest wait for the first process, and for another one when all have ended, s. A busy cluster may need minutes to
make room."""

REPLACEMENT_S = 30.0
"""The same when others gave up for a common cause, s: the processes that still start will hardly fare better."""

START_TRIES = 3
"""How many processes may fail at their start, while none runs."""


class PoolWorker(Protocol):
    """A process that judges windows."""

    def submit(self, job: Job) -> None:
        """Sends a window to the process, which has started. Does not raise if it has ended meanwhile."""

    def close(self) -> None:
        """Ends the process at once, whatever it is doing. What it still sends is dropped."""


@dataclass(frozen=True, slots=True)
class WorkerStarted:
    """A process runs and can judge windows."""

    worker: PoolWorker


@dataclass(frozen=True, slots=True)
class WindowEvaluated:
    """A process has judged a window."""

    worker: PoolWorker
    row: WindowRow


@dataclass(frozen=True, slots=True)
class WorkerStopped:
    """A process has ended, could not start, or must be ended.

    Attributes:
        worker: the process.
        code: error code for its windows.
        text: why, for people.
        blame: whether a window may have caused it. False: the machine was lost.
    """

    worker: PoolWorker
    code: str
    text: str
    blame: bool = True


WorkerEvent = WorkerStarted | WindowEvaluated | WorkerStopped


class WorkerFactory(Protocol):
    """Starts processes, and reports what happens to them."""

    def start(self) -> PoolWorker:
        """Begins to start a process; returns at once."""

    def events(self, workers: Sequence[PoolWorker], timeout_s: float) -> Iterable[WorkerEvent]:
        """What has happened to these processes; waits for the first event, at most for so long."""


@dataclass(slots=True)
class _Slot:
    """What the pool knows about a process.

    Attributes:
        started: whether it runs.
        jobs: the windows that it has, by URL.
        progress_s: when it last finished something, or got windows after it had none.
        alike: how many windows in succession failed for a common cause.
    """

    progress_s: float
    started: bool = False
    jobs: dict[str, Job] = field(default_factory=dict)
    alike: int = 0


class WorkerPool:
    """The processes that judge one batch."""

    def __init__(
        self, workers: WorkerFactory, bounds: WorkerLimits, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._workers = workers
        self._bounds = bounds
        self._clock = clock
        self._slots: dict[PoolWorker, _Slot] = {}
        self._failed_starts = 0
        self._common: WindowRow | None = None
        self._available_s = clock()

    def rows(self, jobs: Sequence[Job], cores: int) -> Iterator[WindowRow]:
        """A row for each window, exactly one, in the order in which they are finished.

        Args:
            jobs: the windows, each once.
            cores: largest number of processes at a time.

        Raises:
            FleetError: no process can be started, or windows could not be judged for a common cause. Those have no row.
        """
        queue = WindowQueue(jobs)
        self._available_s = self._clock()
        try:
            for _ in range(min(cores, len(jobs))):
                self._start()
            while queue or any(slot.jobs for slot in self._slots.values()):
                self._assign(queue)
                for event in self._workers.events(list(self._slots), POLL_S):
                    yield from self._handle(event, queue)
                yield from self._stop_late(queue)
                self._check_available()
            if queue.unjudged:
                raise self._error(f"{queue.unjudged} of {len(jobs)} windows could not be evaluated")
        finally:  # also if the caller stops before the end
            for worker in self._slots:
                worker.close()

    def _start(self) -> None:
        self._slots[self._workers.start()] = _Slot(self._clock())

    def _assign(self, queue: WindowQueue) -> None:
        # One window each before anybody gets a second one, so that the last windows run side by side.
        for has in range(WINDOWS_PER_WORKER):
            for worker, slot in self._slots.items():
                if slot.started and len(slot.jobs) == has and (job := queue.next_for(slot.jobs.values())) is not None:
                    if not slot.jobs:
                        slot.progress_s = self._clock()
                    slot.jobs[job.url] = job
                    worker.submit(job)

    def _handle(self, event: WorkerEvent, queue: WindowQueue) -> Iterator[WindowRow]:
        slot = self._slots.get(event.worker)
        if slot is None:  # it has been given up, and its windows are with others
            return
        if isinstance(event, WorkerStarted):
            slot.started = True
            self._failed_starts = 0
        elif isinstance(event, WorkerStopped):
            yield from self._replace(event, queue)
        else:
            slot.progress_s = self._clock()
            job = slot.jobs.pop(event.row.url, None)
            if job is None:  # answered already
                return
            if self._bounds.alike is None or event.row.error_code not in COMMON_CAUSES:
                slot.alike = 0
                yield event.row
                return
            self._common = event.row
            queue.postpone(job)
            slot.alike += 1
            if slot.alike >= self._bounds.alike:
                self._retire(event.worker, event.row, queue)

    def _replace(self, event: WorkerStopped, queue: WindowQueue) -> Iterator[WindowRow]:
        """Replaces a process, and passes its windows on."""
        slot = self._slots.pop(event.worker)
        event.worker.close()
        if slot.started or not event.blame:
            self._start()
        elif not self._any_started():
            self._failed_starts += 1
            if self._failed_starts >= START_TRIES:
                raise FleetError(event.text)
            self._start()
        else:
            _log.warning("an evaluation process could not start", extra={"fields": {"reason": event.text}})
        jobs = slot.jobs.values()
        if event.blame:
            yield from queue.retry_alone(jobs, event.code, event.text)
        else:
            fields = {"reason": event.text, "windows": [job.url for job in jobs]}
            _log.warning("windows of a lost evaluation process are assigned to others", extra={"fields": fields})
            yield from queue.requeue_lost(jobs, event.text)

    def _retire(self, worker: PoolWorker, row: WindowRow, queue: WindowQueue) -> None:
        """Gives a process up that fails every window for the same cause; its windows go to others."""
        slot = self._slots.pop(worker)
        worker.close()
        queue.requeue(slot.jobs.values())
        _log.warning(
            "an evaluation process fails on every window and receives no more",
            extra={"fields": {"code": row.error_code, "reason": row.error}},
        )

    def _stop_late(self, queue: WindowQueue) -> Iterator[WindowRow]:
        now_s = self._clock()
        for worker, slot in list(self._slots.items()):
            if slot.jobs and now_s - slot.progress_s > self._bounds.seconds:
                yield from self._replace(WorkerStopped(worker, DEADLINE, self._bounds.deadline_message), queue)

    def _any_started(self) -> bool:
        return any(slot.started for slot in self._slots.values())

    def _check_available(self) -> None:
        """Raises:
        FleetError: no process runs, and none can be expected.
        """
        now_s = self._clock()
        if self._any_started():
            self._available_s = now_s
            return
        waited_s = now_s - self._available_s
        if self._common is not None and (not self._slots or waited_s > REPLACEMENT_S):
            raise self._error("the batch stops early")
        if not self._slots or waited_s > START_S:
            raise FleetError(
                f"no evaluation process has started within {START_S:g} s: each needs a core and "
                f"{self._bounds.bytes >> 20} MiB (--memory); finished rows are kept, and --resume continues"
            )

    def _error(self, what: str) -> FleetError:
        """The error of a batch with windows that failed for a common cause."""
        row = self._common
        assert row is not None
        advice = COMMON_CAUSES[str(row.error_code)]
        return FleetError(
            f"{what}, because of a failure that does not depend on the window: {str(row.error).rstrip('.')}; {advice}. "
            "These windows have no row: --resume tries them again, --keep-going writes a row with the error for each"
        )
