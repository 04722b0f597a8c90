"""The supervisor of the worker process. It hands the worker one job at a time, and replaces the process if it crashes,
hangs, grows too large or answers what nobody asked.

The worker infers depth and solves windows in a process of its own, so that neither a fault in a network nor a long
solve can reach the part that answers queries. Jobs wait here, in the service (`queue`). So a worker that dies takes at
most one job with it, and every job gets its outcome whatever happens to the worker.
"""

import logging
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any

from coec.calibration.types import Reason
from coec.config import WorkerConfig
from coec.io.system import ServiceThread
from coec.service.timing import LONG_S, Histogram
from coec.service.worker import worker_jobs
from coec.service.worker.child_process import Child, ChildError, Fault
from coec.service.worker.compilation import STALLED_S, Compilation, Compiling
from coec.service.worker.job_queue import WORKER_FAILED, InProgress, JobQueue, Ticket

_log = logging.getLogger(__name__)

POLL_S = 0.1
"""Time between two looks at a worker, s. It is short against any job; a stop may have to wait this long."""

START_TIMEOUT_S = 300.0
"""Longest start of a worker, s, without the time of compiling kernels."""

FIRST_BACKOFF_S, LAST_BACKOFF_S = 0.5, 30.0
"""Pauses before a worker that could not start is started again, s; each is twice the one before. A worker that started
and ended without a single answer is started again after the first pause."""


SENT_AGAIN = (worker_jobs.Kind.SOLVE, worker_jobs.Kind.COMMISSION)
"""Jobs that may be sent more than once: to another worker, or for the next slice."""


NOT_WHILE_COMPILING = (worker_jobs.Kind.CHECK, worker_jobs.Kind.REGISTER)
"""Jobs that are refused while the worker `warms_up`: their data would be minutes old at the answer."""


NOT_STARTED = "waiting for the worker"
"""How far a commissioning is that was not begun."""


class WorkerState(StrEnum):
    """What the worker is doing."""

    STARTING = "starting"
    READY = "ready"
    BUSY = "busy"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class SupervisorStatus:
    """State and counters of the worker.

    Attributes:
        state: what the worker is doing.
        starts: number of processes so far, including those that could not be started.
        failure: why the last process was replaced.
        rss_bytes: resident memory of the process when it was last looked at.
        compiling: how far the compilation of kernels is; None if none are being compiled.
        in_progress: the work that the process has.
        waiting: number of waiting jobs, by kind; see `JobQueue.waiting`.
        commissionings: how far the commissioning of each pair is that has one, in words.
        outcomes: number of ended jobs, by fate.
        losses: number of jobs without a result by the code of their reason, and other losses; see `JobQueue.causes`.
            `done_raised`: outcomes on which the asking side raised an exception.
        faults: number of processes that were replaced, by cause.
    """

    state: WorkerState
    starts: int
    failure: Reason | None
    rss_bytes: int
    compiling: Compiling | None
    in_progress: InProgress | None
    waiting: Mapping[str, int]
    commissionings: Mapping[str, str]
    outcomes: Mapping[worker_jobs.Fate, int]
    losses: Mapping[str, int]
    faults: Mapping[Fault, int]


class _Reached(IntEnum):
    """How far a worker process came."""

    NOTHING = 0
    READY = 1
    ANSWER = 2


class Worker:
    """Owns the worker process. `start` and `request_stop` are for the daemon, the rest may be called from any thread.

    Attributes:
        thread: the supervisor's thread, on which most outcomes are reported, one at a time.
        jobs_took: time from a question to its result, by kind.
        work_took: the part of that time during which the process worked on it.
    """

    def __init__(
        self,
        config: WorkerConfig,
        settings: str,
        command: Sequence[str] = (sys.executable, "-m", "coec.service.worker.worker_main"),
        pay: Callable[[worker_jobs.Cost], None] = lambda _: None,
    ) -> None:
        """`settings` is the JSON of the `Config` that every process gets. `command` starts a process; two arguments are
        added: the descriptor of its socket and the id of this process. `pay` is called with all processor time that the
        process takes, on the supervisor's thread; for a job before its outcome is reported."""
        self._config = config
        self._settings = settings
        self._sent_settings = ""
        self._command = tuple(command)
        self._pay = pay
        self._compilation = Compilation()
        self._is_preparing, self._is_warm = True, True
        self._condition = threading.Condition()
        # All threads use the queue, so it is used only under the condition.
        self._queue = JobQueue(config.attempts)
        # Written only by the supervisor, read by all.
        self._state = WorkerState.STARTING
        self._starts = 0
        self._failure: Reason | None = None
        self._unusable: Reason | None = None
        self._was_ready = False
        self._rss_bytes = 0
        self._pid: int | None = None
        self._faults: Counter[Fault] = Counter()
        self._done_raised = 0
        self.thread = ServiceThread("worker-supervisor", self._supervise)
        self.jobs_took = Histogram(LONG_S)
        self.work_took = Histogram(LONG_S)

    def start(self) -> None:
        """Starts the supervisor, which starts the process."""
        self.thread.start()

    def reconfigure(self, settings: str) -> None:
        """Goes on with another configuration, which holds for every job that is asked for from now on."""
        with self._condition:
            self._settings = settings

    def request_stop(self) -> None:
        """Ends the supervisor, which kills the process whatever it is doing. When this returns, all jobs have been
        answered (`stopping`). Unsolved windows stay on the disk."""
        self.thread.request_stop()
        with self._locked_queue() as queue:
            queue.stop(self._now_s())
            self._condition.notify_all()

    def submit(self, job: worker_jobs.WorkerJob) -> None:
        """Queues a job; `job.done` will be called once, perhaps before this returns."""
        compiling = self._compilation.status if self.warms_up and job.kind in NOT_WHILE_COMPILING else None
        with self._locked_queue() as queue:
            if compiling is not None:
                queue.refuse(job, compiling.reason, self._now_s())
                return
            queue.submit(job, self._now_s())
            self._condition.notify_all()

    def commissioning(self, pair: str) -> str | None:
        """How far the commissioning of a pair is, in words; None: it has none."""
        with self._condition:
            commissionings = self._queue.commissionings
        return None if pair not in commissionings else str(commissionings[pair] or NOT_STARTED)

    def prefetch(self, pair: str, frame: bytes) -> None:
        """Queues the depth inference of a camera frame (native msgpack). It only saves time, so it may be dropped."""
        with self._locked_queue() as queue:
            queue.prefetch(worker_jobs.Prefetch(pair, frame))
            self._condition.notify_all()

    @property
    def unusable(self) -> Reason | None:
        """Why no worker can ever start with this configuration, for example because of a bad model. Set if a worker
        says so before any was ready."""
        return self._unusable

    @property
    def pid(self) -> int | None:
        """Process id of the current worker."""
        return self._pid

    @property
    def warms_up(self) -> bool:
        """Whether a worker compiles kernels before it takes jobs by its configuration."""
        return self._is_preparing and self._compilation.status is not None

    @property
    def compiled_s(self) -> float:
        """Time that workers have spent compiling kernels so far, s. It counts towards no time limit."""
        return self._compilation.paused_s

    def status(self) -> SupervisorStatus:
        """State and counters of the worker."""
        raised = {"done_raised": self._done_raised} if self._done_raised else {}
        with self._condition:
            return SupervisorStatus(
                self._state,
                self._starts,
                self._failure,
                self._rss_bytes,
                self._compilation.status,
                self._queue.in_progress(self._now_s()),
                self._queue.waiting,
                {pair: str(reached or NOT_STARTED) for pair, reached in self._queue.commissionings.items()},
                self._queue.outcomes,
                {**self._queue.causes, **raised},
                dict(self._faults),
            )

    # --- on any thread ----------------------------------------------------------------------------------------------

    def _now_s(self) -> float:
        """Time of all jobs: a steady clock that stands still while the worker compiles kernels, s."""
        return self._compilation.now_s()

    @contextmanager
    def _locked_queue(self) -> Iterator[JobQueue]:
        """The queue under its lock. Outcomes of jobs that end in the block are reported after it, without the lock."""
        with self._condition:
            yield self._queue
            finished = self._queue.drain()
        for job, outcome in finished:
            if outcome.fate is worker_jobs.Fate.RESULT:
                self.jobs_took.add(outcome.elapsed_s, job.kind.value)
            try:
                job.done(outcome)
            except Exception:
                with self._condition:
                    self._done_raised += 1
                fields = {"kind": job.kind.value, "pair": job.pair, "subject": job.subject, "fate": outcome.fate.value}
                _log.exception("the result of a job could not be processed", extra={"fields": fields})

    # --- on the supervisor's thread ---------------------------------------------------------------------------------

    def _supervise(self, thread: ServiceThread) -> None:
        backoff_s = FIRST_BACKOFF_S
        try:
            while not thread.stopping:
                reached = self._run_child()
                if reached is not _Reached.NOTHING:
                    backoff_s = FIRST_BACKOFF_S
                if reached is not _Reached.ANSWER:
                    self._pause(backoff_s)
                if reached is _Reached.NOTHING:
                    backoff_s = min(2 * backoff_s, LAST_BACKOFF_S)
        finally:
            self._state = WorkerState.STOPPED
            with self._locked_queue() as queue:
                queue.stop(self._now_s())

    def _run_child(self) -> _Reached:
        """Runs one process from its start to its end."""
        self._state = WorkerState.STARTING
        self._starts += 1
        try:
            child = Child(self._command, self._config)
        except ChildError as error:
            self._note_fault(error, None)
            return _Reached.NOTHING
        reached = _Reached.NOTHING
        self._pid = child.pid
        try:
            try:
                self._await_ready(child)
            finally:
                self._pay(worker_jobs.Cost(worker_jobs.START, "", child.taken_s()))
            reached = _Reached.READY
            while not self.thread.stopping:
                if self._take_turn(child):
                    reached = _Reached.ANSWER
        except ChildError as error:
            self._note_fault(error, child.pid)
            with self._locked_queue() as queue:
                queue.died(str(error), self._now_s())
        finally:
            self._pid = None
            self._compilation.end()
            child.kill()
        return reached

    def _await_ready(self, child: Child) -> None:
        self._is_preparing = True
        with self._condition:
            self._sent_settings = self._settings
        child.send({"kind": "start", "settings": self._sent_settings})
        message = self._next_message(child, START_TIMEOUT_S)
        match message:
            case None:
                return
            case {"kind": "ready"}:
                self._was_ready, self._is_preparing = True, False
                self._is_warm = message.get("more") is not True
                return
            case {"kind": "unusable", "code": str(code), "text": str(text)}:
                if not self._was_ready:
                    self._unusable = Reason(code, text)
                raise ChildError(Fault.UNUSABLE, f"cannot work with this configuration: {text}")
        raise ChildError(Fault.MALFORMED_ANSWER, "sent an unexpected message instead of ready")

    def _take_turn(self, child: Child) -> bool:
        """Checks the worker, then gives it the next job, if there is one. Returns whether it has answered a job."""
        self._watch(child)
        if child.has_message(0.0) and not self._compilation.take(child.receive()):  # raises if the process has ended
            raise ChildError(Fault.STRAY_ANSWER, "sent a reply without a request")
        if self._sent_settings != self._settings:
            self._await_ready(child)
        ticket = self._take()
        if ticket is None:
            if not self._is_warm:
                self._warm_up_further(child)
            return False
        kind = ticket.work.kind if isinstance(ticket.work, worker_jobs.WorkerJob) else None
        timeout_s = ticket.work.timeout_s if isinstance(ticket.work, worker_jobs.WorkerJob) else None
        self._pay(worker_jobs.Cost(worker_jobs.IDLE, "", child.taken_s()))
        try:
            self._send(child, ticket)
            sent_s = self._now_s()
            message = self._next_message(child, timeout_s or self._config.timeout_s)
        finally:
            self._pay(worker_jobs.cost_of(ticket.work, child.taken_s()))
        if message is None:
            return False
        self.work_took.add(self._now_s() - sent_s, worker_jobs.PREFETCH if kind is None else kind.value)
        answer = _checked_answer(message, ticket.number, kind)
        if isinstance(answer, worker_jobs.Underway):
            self._log_progress(ticket.work.pair, answer)
        with self._locked_queue() as queue:
            queue.answered(answer, self._now_s())
        return True

    def _warm_up_further(self, child: Child) -> None:
        """Lets the worker compile the next of the kernels that no check needs, while nothing else waits."""
        child.send({"kind": "warm_up"})
        try:
            message = self._next_message(child, self._config.timeout_s)
        finally:
            self._pay(worker_jobs.Cost(worker_jobs.START, "", child.taken_s()))
        match message:
            case None:
                return
            case {"kind": "warmed", "more": bool(more)}:
                self._is_warm = not more
                return
        raise ChildError(Fault.MALFORMED_ANSWER, "sent an unexpected message during its warm-up")

    def _log_progress(self, pair: str, reached: worker_jobs.Underway) -> None:
        """Logs how far a commissioning is, once per stage."""
        with self._condition:
            before = self._queue.commissionings.get(pair)
        if before is None or before.stage != reached.stage:
            _log.info(f"commissioning: {reached}", extra={"fields": {"pair": pair}})

    def _take(self) -> Ticket | None:
        """The next job; None if there is none, after waiting for `POLL_S` at most."""
        with self._locked_queue() as queue:
            ticket = queue.take(self._now_s())
            # A worker that compiles kernels while nothing waits is at work, too.
            self._state = WorkerState.READY if ticket is None and self._is_warm else WorkerState.BUSY
            if ticket is None and self._is_warm:
                self._condition.wait(POLL_S)
        return ticket

    def _send(self, child: Child, ticket: Ticket) -> None:
        try:
            child.send(_request_message(ticket))
        except ChildError as error:
            if error.fault is Fault.UNSENDABLE_JOB:
                with self._locked_queue() as queue:
                    queue.answered(Reason("unsendable", f"The worker {error}."), self._now_s())
            raise
        if isinstance(ticket.work, worker_jobs.WorkerJob) and ticket.work.kind not in SENT_AGAIN:
            ticket.work.body.clear()  # frees the frames of a check, 15 MB, which are not sent twice
        with self._locked_queue() as queue:
            queue.sent(self._now_s())

    def _next_message(self, child: Child, timeout_s: float) -> dict[str, Any] | None:
        """The worker's next message that is not about the compilation of kernels, whose time does not count; None if a
        stop was requested meanwhile.

        Raises:
            ChildError: the worker is dead, too slow or too large, or its message cannot be understood.
        """
        deadline_s = self._now_s() + timeout_s
        while True:
            while not child.has_message(POLL_S):
                if self.thread.stopping:
                    return None
                self._watch(child)
                if self._compilation.has_stalled:
                    text = f"made no progress in the compilation of its kernels within {STALLED_S:g} s"
                    raise ChildError(Fault.TIMED_OUT, text)
                if self._now_s() > deadline_s:
                    raise ChildError(Fault.TIMED_OUT, f"did not reply within {timeout_s:g} s")
            message = child.receive()
            if not self._compilation.take(message):
                self._compilation.end()
                return message
            self._watch(child)

    def _watch(self, child: Child) -> None:
        """Checks time limits, memory and life of the worker; called many times a second.

        Raises:
            ChildError: the worker is dead or too large.
        """
        self._keep_time()
        self._rss_bytes = child.watch()

    def _keep_time(self) -> None:
        self.thread.beat()
        with self._locked_queue() as queue:
            queue.expire(self._now_s())

    def _note_fault(self, error: ChildError, pid: int | None) -> None:
        if self.thread.stopping:
            return
        with self._condition:
            self._faults[error.fault] += 1
        self._failure = Reason(WORKER_FAILED, f"The worker {error} and is being replaced.")
        fields = {"pid": pid, "starts": self._starts, "fault": error.fault.value}
        _log.error(self._failure.text, extra={"fields": fields})

    def _pause(self, seconds: float) -> None:
        self._state = WorkerState.STARTING
        end_s = time.monotonic() + seconds
        while not self.thread.stopping and time.monotonic() < end_s:
            self._keep_time()
            with self._condition:
                self._condition.wait(POLL_S)


def _request_message(ticket: Ticket) -> dict[str, Any]:
    """The message to the worker."""
    work = ticket.work
    if isinstance(work, worker_jobs.Prefetch):
        return {"id": ticket.number, "kind": worker_jobs.PREFETCH, "pair": work.pair, "frame": work.frame}
    return {**work.body, "id": ticket.number, "kind": work.kind.value, "pair": work.pair}


def _checked_answer(
    message: Mapping[str, Any], number: int, kind: worker_jobs.Kind | None
) -> worker_jobs.Answer | worker_jobs.Underway | Reason | None:
    """The answer to the question of this number and kind.

    Raises:
        ChildError: the answer is to another question, or not of the documented form.
    """
    try:
        if worker_jobs.number_of(message) != number:
            raise ChildError(Fault.STRAY_ANSWER, "replied to another request")
        return worker_jobs.read_answer(message, kind)
    except worker_jobs.MalformedAnswerError as error:
        raise ChildError(Fault.MALFORMED_ANSWER, f"sent a malformed reply: {error}") from error
