"""The supervisor of the worker process: hands it one job at a time and replaces it when it crashes, hangs or grows.

The worker infers depth and solves windows in a process of its own, so that neither a fault in a network nor a long
solve can reach the part that answers queries. Jobs wait here, in the service: a worker that dies takes at most the
job it had with it, and that is tried again on the next one.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from coec.adapters.system.threads import ServiceThread
from coec.calibration.types import Reason
from coec.config import WorkerConfig
from coec.runtime.worker.link import Link

_log = logging.getLogger(__name__)

POLL_S = 0.1
"""How often a busy or idle worker is looked at: small against any job, and what a stop may have to wait."""

START_TIMEOUT_S = 300.0
"""A first start compiles every kernel: tens of seconds on a slow machine."""

PREFETCHES_WAITING = 8
"""Images that may wait for early inference, some MB each; beyond, the solve infers them itself."""

BACKLOG = 64
"""Unsolved windows of earlier runs that may wait."""

CHECKS_WAITING, WINDOWS_WAITING = 4, 2
"""Checks, and windows of this run, that may wait per pair. The service waits for answers before it asks more; these are
for a worker that does not answer."""

ERRANDS_WAITING = 8
"""Pictures and commissionings that may wait."""

FIRST_BACKOFF_S, LAST_BACKOFF_S = 0.5, 30.0
"""Pause before a worker that could not start is started again; doubles from the first to the last."""

PACKAGE_ROOT = Path(__file__).resolve().parents[3]


class WorkerState(StrEnum):
    """What the worker is doing."""

    STARTING = "starting"
    READY = "ready"
    BUSY = "busy"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class SolveJob:
    """A finished window to calibrate. `live` is False for windows left over from an earlier run."""

    pair: str
    window_id: str
    path: Path
    live: bool = True


@dataclass(frozen=True, slots=True)
class Solved:
    """What the worker made of a window: msgpack of a `CalibrationResult`, seconds, and whether the file has it too."""

    job: SolveJob
    result: bytes
    elapsed_s: float
    note: Reason | None


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """How the worker is. `starts` counts processes, `failure` says why the last one was replaced."""

    state: WorkerState
    starts: int
    failure: Reason | None
    window_id: str | None
    waiting: int
    rss_bytes: int
    prefetches_dropped: int


SUPERSEDED = Reason("superseded", "A newer window of the pair came before the worker was free.")


@dataclass(frozen=True, slots=True, eq=False)
class Errand:
    """Work that is done once or not at all.

    Attributes:
        kind: `check`, `overlay` or `commission`, as `process` knows them.
        pair: whose.
        body: what the work needs, in values that msgpack knows.
        done: called once, on the supervisor's thread or on the one that asked, with the worker's answer, or why there
            is none.
        timeout_s: after which the worker is replaced; None for that of a solve.
    """

    kind: str
    pair: str
    body: dict[str, Any]
    done: Callable[[dict[str, Any] | Reason], None]
    timeout_s: float | None = None


CHECK = "check"
"""The kind of a check of the monitor."""

BUSY = Reason("busy", "Too much waits for the worker; ask again in a moment.")


_Job = TypeVar("_Job", SolveJob, Errand)


@dataclass(frozen=True, slots=True)
class _Prefetch:
    pair: str
    frame: bytes


class _ChildError(Exception):
    """The worker process has to be replaced; the message says why."""


class _Child:
    """One worker process."""

    def __init__(self, command: Sequence[str], config: WorkerConfig) -> None:
        self.link, theirs = Link.pair()
        with theirs:
            self._process = subprocess.Popen(
                [*command, str(theirs.fileno()), str(os.getpid())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=_environment(config.threads),
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    def exit_text(self, wait_s: float = 0.0) -> str | None:
        """How the process ended, or None while it lives; it gets `wait_s` to end."""
        try:
            code = self._process.wait(wait_s)
        except subprocess.TimeoutExpired:
            return None
        return f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"

    def rss_bytes(self) -> int:
        """Resident memory; 0 when the process is gone."""
        with contextlib.suppress(OSError, IndexError, ValueError):
            pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
            return pages * os.sysconf("SC_PAGE_SIZE")
        return 0

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self.link.close()


class Worker:
    """Owns the worker process. `start()` and `stop()` are for the daemon, the rest may be called from any thread.

    `on_solved` and `on_failed` are called on the supervisor's thread, one at a time.
    Per pair only the newest live windows wait: an older one that has not been begun is given up, with a call of
    `on_failed` whose reason is `superseded`.
    """

    def __init__(
        self,
        config: WorkerConfig,
        settings: str,
        on_solved: Callable[[Solved], None],
        on_failed: Callable[[SolveJob, Reason], None],
        command: Sequence[str] = (sys.executable, "-m", "coec.runtime.worker.process"),
    ) -> None:
        """`settings` is the JSON of the `Config`, handed to every process; `command` starts one, given two more
        arguments: the descriptor of its socket and the id of this process."""
        self._config = config
        self._settings = settings
        self._on_solved = on_solved
        self._on_failed = on_failed
        self._command = tuple(command)
        self._condition = threading.Condition()
        self._live: deque[SolveJob] = deque()
        self._backlog: deque[SolveJob] = deque()
        self._prefetches: deque[_Prefetch] = deque(maxlen=PREFETCHES_WAITING)
        self._checks: deque[Errand] = deque()
        self._errands: deque[Errand] = deque()
        self._check_was_fatal = False
        self._attempts: dict[SolveJob, int] = {}
        self._state = WorkerState.STARTING
        self._starts = 0
        self._failure: Reason | None = None
        self._unusable: Reason | None = None
        self._window_id: str | None = None
        self._rss_bytes = 0
        self._pid: int | None = None
        self._prefetches_dropped = 0
        self.thread = ServiceThread("worker-supervisor", self._supervise)

    def start(self) -> None:
        """Start the supervisor, which starts the process."""
        self.thread.start()

    def request_stop(self) -> None:
        """Kill the process, whatever it does, and end the supervisor; windows not solved stay on the disk."""
        self.thread.request_stop()
        with self._condition:
            self._condition.notify_all()

    def solve(self, job: SolveJob) -> None:
        """Queue a window."""
        superseded = None
        with self._condition:
            if job.live:
                if job not in self._live:
                    superseded = _oldest(self._live, job.pair, WINDOWS_WAITING)
                    self._live.append(job)
            elif len(self._backlog) < BACKLOG:
                self._backlog.append(job)
            self._condition.notify_all()
        if superseded is not None:
            self._on_failed(superseded, SUPERSEDED)

    def prefetch(self, pair: str, frame: bytes) -> None:
        """Queue the depth inference of a camera frame (native msgpack); only a head start, so it may be dropped."""
        with self._condition:
            if len(self._prefetches) == PREFETCHES_WAITING:
                self._prefetches_dropped += 1
            self._prefetches.append(_Prefetch(pair, frame))
            self._condition.notify_all()

    def check(self, errand: Errand) -> None:
        """Queue a check of the monitor, in front of everything: it is short. Per pair only the newest wait."""
        with self._condition:
            superseded = _oldest(self._checks, errand.pair, CHECKS_WAITING)
            self._checks.append(errand)
            self._condition.notify_all()
        if superseded is not None:
            superseded.done(SUPERSEDED)

    def run_errand(self, errand: Errand) -> None:
        """Queue other work, behind the windows; when too much waits it is answered with `BUSY` at once."""
        with self._condition:
            full = len(self._errands) >= ERRANDS_WAITING
            if not full:
                self._errands.append(errand)
            self._condition.notify_all()
        if full:
            errand.done(BUSY)

    @property
    def unusable(self) -> Reason | None:
        """Why no worker can ever start with this configuration, as far as the first one said so (a bad model)."""
        return self._unusable

    @property
    def pid(self) -> int | None:
        """Process id of the current worker."""
        return self._pid

    def status(self) -> WorkerStatus:
        """How the worker is."""
        with self._condition:
            waiting = len(self._checks) + len(self._live) + len(self._backlog)
            return WorkerStatus(
                self._state,
                self._starts,
                self._failure,
                self._window_id,
                waiting,
                self._rss_bytes,
                self._prefetches_dropped,
            )

    # --- on the supervisor's thread ---------------------------------------------------------------------------------

    def _supervise(self, thread: ServiceThread) -> None:
        backoff_s = FIRST_BACKOFF_S
        while not thread.stopping:
            self._state = WorkerState.STARTING
            self._starts += 1
            child = _Child(self._command, self._config)
            self._pid = child.pid
            ready = False
            try:
                self._await_ready(child)
                ready = True
                backoff_s = FIRST_BACKOFF_S
                self._serve(child)
            except (_ChildError, OSError, EOFError) as error:
                self._note_failure(child, error)
            finally:
                self._pid = None
                child.kill()
            if not ready and not thread.stopping:
                self._pause(backoff_s)
                backoff_s = min(2 * backoff_s, LAST_BACKOFF_S)
        self._state = WorkerState.STOPPED

    def _await_ready(self, child: _Child) -> None:
        child.link.send({"kind": "start", "settings": self._settings})
        reply = self._reply(child, START_TIMEOUT_S)
        if reply is None:
            return
        if reply.get("kind") == "unusable":
            reason = Reason(str(reply["code"]), str(reply["text"]))
            if self._starts == 1:
                self._unusable = reason
            raise _ChildError(reason.text)

    def _serve(self, child: _Child) -> None:
        while not self.thread.stopping:
            job = self._next_job(child)
            if job is None:
                continue
            self._state = WorkerState.BUSY
            if isinstance(job, SolveJob):
                self._solve(child, job)
            elif isinstance(job, Errand):
                self._run_errand(child, job)
            else:
                child.link.send({"kind": "prefetch", "pair": job.pair, "frame": job.frame})
                self._reply(child, self._config.timeout_s)

    def _solve(self, child: _Child, job: SolveJob) -> None:
        self._window_id = job.window_id
        self._attempts[job] = self._attempts.get(job, 0) + 1
        started_s = time.monotonic()
        try:
            child.link.send({"kind": "solve", "pair": job.pair, "path": str(job.path)})
            reply = self._reply(child, self._config.timeout_s)
        except (_ChildError, OSError, EOFError) as error:
            self._after_death(job, child, error)
            raise
        finally:
            self._window_id = None
        if reply is None:
            return
        del self._attempts[job]
        if reply["kind"] == "solved":
            note = Reason(*reply["note"]) if reply.get("note") else None
            self._on_solved(Solved(job, reply["result"], time.monotonic() - started_s, note))
        else:
            self._on_failed(job, Reason(str(reply["code"]), str(reply["text"])))

    def _run_errand(self, child: _Child, errand: Errand) -> None:
        try:
            child.link.send({**errand.body, "kind": errand.kind, "pair": errand.pair})
            errand.body.clear()  # the frames of a check are 15 MB, and are not sent twice
            reply = self._reply(child, errand.timeout_s or self._config.timeout_s)
        except (_ChildError, OSError, EOFError) as error:
            self._check_was_fatal |= errand.kind == CHECK
            errand.done(Reason("worker_failed", f"The worker {_cause(child, error)}."))
            raise
        self._check_was_fatal &= errand.kind != CHECK
        if reply is None:
            errand.done(Reason("stopping", "The service is stopping."))
        elif reply["kind"] == "refused":
            errand.done(Reason(str(reply["code"]), str(reply["text"])))
        else:
            errand.done(reply)

    def _after_death(self, job: SolveJob, child: _Child, error: Exception) -> None:
        """Put the window back in front, unless it has had its attempts or a newer one of its pair has come."""
        attempts = self._attempts[job]
        given_up = None
        with self._condition:
            if attempts >= self._config.attempts:
                text = f"The worker failed on this window {attempts} times; the last one {_cause(child, error)}."
                given_up = Reason("worker_failed", text)
            elif not job.live:
                self._backlog.appendleft(job)
            elif sum(waiting.pair == job.pair for waiting in self._live) >= WINDOWS_WAITING:
                given_up = SUPERSEDED
            else:
                self._live.appendleft(job)
        if given_up is not None:
            del self._attempts[job]
            self._on_failed(job, given_up)

    def _next_job(self, child: _Child) -> SolveJob | Errand | _Prefetch | None:
        """The next job, or None when there was none for a moment.

        Raises:
            _ChildError: the idle worker died or grew too large.
        """
        with self._condition:
            job = self._take()
            if job is None:
                self._state = WorkerState.READY
                self._condition.wait(POLL_S)
        self._check(child)
        return job

    def _take(self) -> SolveJob | Errand | _Prefetch | None:
        # Checks that kill must not keep every new worker from its windows.
        if self._checks and not (self._check_was_fatal and self._live):
            return self._checks.popleft()
        if self._live:
            return self._live.popleft()
        if self._errands:
            return self._errands.popleft()
        if self._prefetches:
            return self._prefetches.popleft()
        return self._backlog.popleft() if self._backlog else None

    def _reply(self, child: _Child, timeout_s: float) -> dict[str, Any] | None:
        """The worker's next message; None when a stop was requested meanwhile.

        Raises:
            _ChildError: dead, too slow or too large.
        """
        deadline_s = time.monotonic() + timeout_s
        while not child.link.poll(POLL_S):
            self._check(child)
            if self.thread.stopping:
                return None
            if time.monotonic() > deadline_s:
                raise _ChildError(f"gave no answer within {timeout_s:g} s")
        return child.link.receive()

    def _check(self, child: _Child) -> None:
        self.thread.beat()
        exit_text = child.exit_text()
        if exit_text is not None:
            raise _ChildError(exit_text)
        self._rss_bytes = child.rss_bytes()
        if self._rss_bytes > self._config.max_memory_bytes:
            raise _ChildError(
                f"used {self._rss_bytes >> 20} MiB of memory; worker.max_memory_bytes allows "
                f"{self._config.max_memory_bytes >> 20} MiB"
            )

    def _note_failure(self, child: _Child, error: Exception) -> None:
        if self.thread.stopping:
            return
        self._failure = Reason("worker_failed", f"The worker {_cause(child, error)} and is being replaced.")
        _log.error(self._failure.text, extra={"fields": {"pid": child.pid, "starts": self._starts}})

    def _pause(self, seconds: float) -> None:
        deadline_s = time.monotonic() + seconds
        with self._condition:
            while not self.thread.stopping and time.monotonic() < deadline_s:
                self.thread.beat()
                self._condition.wait(POLL_S)


def _oldest(waiting: deque[_Job], pair: str, most: int) -> _Job | None:
    """Takes out the oldest job of a pair if there are `most` of them."""
    of_pair = [job for job in waiting if job.pair == pair]
    if len(of_pair) < most:
        return None
    waiting.remove(of_pair[0])
    return of_pair[0]


def _cause(child: _Child, error: Exception) -> str:
    """What to say of a failed worker: its exit tells more than the broken pipe that it left."""
    if isinstance(error, _ChildError):
        return str(error)
    return child.exit_text(wait_s=1.0) or f"broke the connection ({type(error).__name__})"


def _environment(threads: int) -> dict[str, str]:
    inherited = os.environ.get("PYTHONPATH")
    path = os.pathsep.join([str(PACKAGE_ROOT), *([inherited] if inherited else [])])
    limits = {name: str(threads) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    # What is multiplied as matrices is (N, 3) by (3, 3): more threads only spin, for longer than the work takes.
    limits["OPENBLAS_NUM_THREADS"] = "1"
    return {**os.environ, **limits, "PYTHONPATH": path}
