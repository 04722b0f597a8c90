"""The engines of a batch: this machine with a pool of processes, each on a core of its own, and a Ray cluster.

Each process is an actor on one core. It declares the memory that a window may take, so that the cluster places no more
actors than it can hold.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, cast

from coec import __version__
from coec.errors import SourceError
from coec.fleet import worker_pool
from coec.fleet.evaluator import ReplaySettings, WindowEvaluator
from coec.fleet.jobs import Job, StoreCredentials, failed_row, is_path, stores_of
from coec.io.system import ONE_THREAD, one_thread_each, resident_bytes
from coec.schemas.documents import WindowRow

STOP_TIMEOUT_S = 5.0
"""Longest wait for a process that was told to end, s."""

READY = ""
"""The first message of a process."""


class _Process:
    """A process on this machine."""

    def __init__(self, settings: str) -> None:
        context = multiprocessing.get_context("spawn")
        self.link, worker_end = context.Pipe()
        with one_thread_each():
            self._process = context.Process(target=_worker_main, args=(worker_end, settings), daemon=True)
            self._process.start()
        worker_end.close()  # so that the pipe ends when the process does
        self.ready = False

    def submit(self, job: Job) -> None:
        """See `Worker`."""
        with suppress(OSError):  # the process has ended, which `received` will report
            self.link.send(job)

    def received(self) -> worker_pool.WorkerEvent:
        """What has come through the pipe."""
        try:
            message = self.link.recv()
        except (EOFError, OSError):
            self._process.join(STOP_TIMEOUT_S)
            status = self._process.exitcode
            if not self.ready:
                return worker_pool.WorkerStopped(
                    self,
                    worker_pool.PROCESS_DIED,
                    f"a process for judging windows ended at its start, with status {status}",
                )
            return worker_pool.WorkerStopped(
                self, worker_pool.PROCESS_DIED, f"the process that judged it ended with status {status}"
            )
        if message == READY:
            self.ready = True
            return worker_pool.WorkerStarted(self)
        return worker_pool.WindowEvaluated(self, WindowRow.model_validate_json(message))

    @property
    def resident_bytes(self) -> int:
        """Memory that it holds, bytes."""
        return resident_bytes(self._process.pid)

    def close(self) -> None:
        """See `Worker`."""
        self.link.close()
        self._process.kill()
        self._process.join(STOP_TIMEOUT_S)


class _Processes:
    """Starts processes on this machine, and bounds their memory."""

    def __init__(self, settings: str, bounds: worker_pool.WorkerLimits) -> None:
        self._settings = settings
        self._bounds = bounds

    def start(self) -> worker_pool.PoolWorker:
        """See `WorkerFactory`."""
        return _Process(self._settings)

    def events(self, workers: Sequence[worker_pool.PoolWorker], timeout_s: float) -> Iterator[worker_pool.WorkerEvent]:
        """See `WorkerFactory`."""
        processes = cast("Sequence[_Process]", workers)
        for process in processes:
            held = process.resident_bytes if process.ready else 0
            if held > self._bounds.bytes:
                text = f"its process held {held >> 20} MiB, of {self._bounds.bytes >> 20} (--memory)"
                yield worker_pool.WorkerStopped(process, worker_pool.TOO_LARGE, text)
        by_link = {process.link: process for process in processes if not process.link.closed}
        for link in wait(list(by_link), timeout_s):
            yield by_link[cast("Connection", link)].received()


class LocalEngine:
    """Runs a process on each core. A window that ends its process, or takes too long or too much memory, gets a row
    with that error; the others go on."""

    def __init__(self, cores: int, bounds: worker_pool.WorkerLimits) -> None:
        self.cores = cores
        self._bounds = bounds

    def rows(self, jobs: Sequence[Job], settings: ReplaySettings) -> Iterator[WindowRow]:
        """See `Engine`."""
        yield from worker_pool.WorkerPool(_Processes(settings.model_dump_json(), self._bounds), self._bounds).rows(
            jobs, self.cores
        )

    def close(self) -> None:
        """See `Engine`."""


# --- in the process -------------------------------------------------------------------------------------------------


def _worker_main(link: Connection, settings: str) -> None:
    """Takes windows until none come any more. Each thread has one window, and one thread at a time solves."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which decides when this process ends
    evaluator = WindowEvaluator(ReplaySettings.model_validate_json(settings))
    link.send(READY)
    receive_lock, send_lock = threading.Lock(), threading.Lock()

    def evaluate_windows() -> None:
        with suppress(EOFError, OSError):  # the parent has gone
            while True:
                with receive_lock:
                    job = link.recv()
                row = evaluator.row(job).model_dump_json()
                with send_lock:
                    link.send(row)

    threads = [
        threading.Thread(target=evaluate_windows, name=f"judge-{index}")
        for index in range(worker_pool.WINDOWS_PER_WORKER)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


# --- a Ray cluster ----------------------------------------------------------------------------------------------------

ADDRESS = "RAY_ADDRESS"
"""Environment variable of Ray with the address of the cluster."""

AUTO = "auto"
"""Address of the cluster that runs on this machine."""

CURRENT = Path(os.environ.get("RAY_TMPDIR", "/tmp")) / "ray" / "ray_current_cluster"
"""File in which Ray keeps the address of the cluster that `ray start` started last on this machine."""

CONNECT_S = 10.0
"""Longest wait for a connection to the cluster, s."""

PING_S, SILENCE_S = 5.0, 45.0
"""Time between two pings of an actor, and longest time without an answer to one, s. Ray itself finds a lost node after
15 s if its connections break, but after more than a minute if it just falls silent."""

GET_S = 30.0
"""Longest time for fetching a row that is finished, s."""

NODE_DIED = "because its node has died"
"""What Ray's error says of an actor whose node was lost."""

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


class _Judge:
    """Runs on a node of the cluster, which has coec installed."""

    def __init__(self, settings: str, credentials: StoreCredentials) -> None:
        credentials.install()  # before the clients of stores are imported, which may read them then
        self._evaluator = WindowEvaluator(ReplaySettings.model_validate_json(settings))

    def versions(self) -> tuple[str, str]:
        """Host name of the node, and the version of coec on it."""
        return socket.gethostname(), __version__

    def ping(self) -> None:
        """Returns at once."""

    def row(self, job: Job) -> str:
        """The row of a window, as JSON. For several threads."""
        return self._evaluator.row(job).model_dump_json()


class _Actor:
    """An actor, and the references of the answers that it owes."""

    def __init__(self, actor: Any, ray: Any) -> None:
        self.actor = actor
        self.versions: Any = actor.versions.remote()
        self.rows: list[Any] = []
        self.ping: Any = None
        self.pinged_s = self.alive_s = 0.0
        self._ray = ray

    @property
    def pending(self) -> list[Any]:
        """References of all answers that have not come."""
        return [*self.rows, *(one for one in (self.versions, self.ping) if one is not None)]

    def submit(self, job: Job) -> None:
        """See `Worker`."""
        self.rows.append(self.actor.row.remote(job))

    def close(self) -> None:
        """See `Worker`."""
        self._ray.kill(self.actor)


class _Actors:
    """Starts actors on the cluster, and reports what happens to them."""

    def __init__(
        self, ray: Any, settings: str, credentials: StoreCredentials, bounds: worker_pool.WorkerLimits
    ) -> None:
        self._ray = ray
        self._arguments = (settings, credentials)
        self._options = {
            "num_cpus": 1,
            "memory": bounds.bytes,
            "max_concurrency": worker_pool.WINDOWS_PER_WORKER + 1,  # one more for pings
            "runtime_env": {"env_vars": dict(ONE_THREAD)},
        }

    def start(self) -> worker_pool.PoolWorker:
        """See `WorkerFactory`."""
        return _Actor(self._ray.remote(_Judge).options(**self._options).remote(*self._arguments), self._ray)

    def events(self, workers: Sequence[worker_pool.PoolWorker], timeout_s: float) -> Iterator[worker_pool.WorkerEvent]:
        """See `WorkerFactory`."""
        actors = cast("Sequence[_Actor]", workers)
        pending = [one for actor in actors for one in actor.pending]
        done: list[Any] = []
        if not pending:
            time.sleep(timeout_s)
        elif self._ray.wait(pending, num_returns=1, timeout=timeout_s)[0]:
            done, _ = self._ray.wait(pending, num_returns=len(pending), timeout=0)
        for actor in actors:
            yield from self._received(actor, set(done))

    def _received(self, actor: _Actor, done: set[Any]) -> Iterator[worker_pool.WorkerEvent]:
        """What an actor has answered, and whether it still does."""
        now_s = time.monotonic()
        try:
            if actor.versions in done:
                answer, actor.versions = self._ray.get(actor.versions, timeout=GET_S), None
                actor.alive_s = now_s
                event = self._started(actor, *answer)
                yield event
                if isinstance(event, worker_pool.WorkerStopped):
                    return
            for row in [row for row in actor.rows if row in done]:
                document = self._ray.get(row, timeout=GET_S)
                actor.rows.remove(row)
                actor.alive_s = now_s
                yield worker_pool.WindowEvaluated(actor, _with_missing_file(WindowRow.model_validate_json(document)))
            if actor.ping in done:
                self._ray.get(actor.ping, timeout=GET_S)
                actor.ping, actor.alive_s = None, now_s
        except self._ray.exceptions.RayError as error:
            yield self._stopped(actor, error)
            return
        if actor.versions is not None:
            return
        if now_s - actor.alive_s > SILENCE_S:
            yield worker_pool.WorkerStopped(
                actor, worker_pool.NODE_LOST, f"the node that had it has not answered for {SILENCE_S:g} s", blame=False
            )
        elif actor.ping is None and now_s - actor.pinged_s > PING_S:
            actor.ping, actor.pinged_s = actor.actor.ping.remote(), now_s

    def _started(self, actor: _Actor, host: str, version: str) -> worker_pool.WorkerEvent:
        if version == __version__:
            return worker_pool.WorkerStarted(actor)
        text = f"the node {host} has coec {version}, but this machine {__version__}"
        return worker_pool.WorkerStopped(actor, worker_pool.PROCESS_DIED, _unusable_cluster(text))

    def _stopped(self, actor: _Actor, error: Exception) -> worker_pool.WorkerEvent:
        """Why an actor does not answer any more: its process ended, or its node was lost."""
        text = _COLOUR.sub("", str(error)).strip()
        if isinstance(error, (self._ray.exceptions.ActorUnavailableError, self._ray.exceptions.GetTimeoutError)) or (
            NODE_DIED in text
        ):
            return worker_pool.WorkerStopped(actor, worker_pool.NODE_LOST, "the node that had it was lost", blame=False)
        if actor.versions is not None:
            return worker_pool.WorkerStopped(
                actor, worker_pool.PROCESS_DIED, _unusable_cluster(text.rpartition("\n")[2].strip())
            )
        return worker_pool.WorkerStopped(
            actor, worker_pool.PROCESS_DIED, f"the process that judged it ended: {type(error).__name__}"
        )


def _unusable_cluster(text: str) -> str:
    return (
        f"no process can judge windows on the Ray cluster: {text}; every node needs coec {__version__} with the same "
        "extras as this machine, in the Python that runs `ray start`"
    )


def _with_missing_file(row: WindowRow) -> WindowRow:
    """The row of a window; if the node lacks a file that this machine has, the row says so."""
    if row.error is None or row.sha256 is not None or not is_path(row.url) or not Path(row.url).is_file():
        return row
    return failed_row(
        row, worker_pool.NOT_ON_NODE, f"a node of the cluster cannot read {row.url}, which exists on this machine"
    )


def _probe(address: str) -> None:
    """Connects to the address of a cluster once, because Ray itself waits for one that does not answer for ever.

    Raises:
        OSError: nobody listens there.
    """
    if address == AUTO:  # Ray takes the latest cluster that was started here, even if it has ended
        with suppress(OSError):
            address = CURRENT.read_text(encoding="utf-8").strip()
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()


class RayEngine:
    """Judges windows on a Ray cluster."""

    def __init__(
        self,
        cores: int | None,
        bounds: worker_pool.WorkerLimits,
        address: str | None = None,
        *,
        send_credentials: bool = True,
    ) -> None:
        """Connects to a cluster.

        Args:
            cores: how many cores are used at most; None: all of the cluster.
            bounds: limits for each window.
            address: `HOST:PORT` of the cluster; `auto`: one that runs on this machine; `local`: one is started on this
                machine, and ends with this process. None: `RAY_ADDRESS`, else `auto`.
            send_credentials: whether this process's credentials for stores are sent to the nodes.

        Raises:
            SourceError: Ray is not installed.
            FleetError: there is no cluster, or it has no room for a process.
        """
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # otherwise Ray reports to its vendor
        try:
            import ray
        except ImportError as error:
            raise SourceError("the engine `ray` needs the optional extra `ray`: pip install 'coec[ray]'") from error
        self._ray = ray
        self._bounds = bounds
        self._send_credentials = send_credentials
        address = address or os.environ.get(ADDRESS) or AUTO
        local_options = {"include_dashboard": False} if address == "local" else {}
        try:
            _probe(address)
            ray.init(
                address, ignore_reinit_error=True, log_to_driver=False, logging_level=logging.ERROR, **local_options
            )
            nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        except Exception as error:  # of Ray, of the system, or of a library in between
            raise worker_pool.FleetError(
                f"no Ray cluster at {address}: {_COLOUR.sub('', str(error)).strip()}",
                f"{ADDRESS}=HOST:6379 or --ray-address names one that runs (`ray start --head` starts it); "
                "--ray-address local starts one on this machine for this batch; --engine local needs none",
            ) from error
        available = sum(int(min(node.get("CPU", 0.0), node.get("memory", 0.0) // bounds.bytes)) for node in nodes)
        if available == 0:
            raise worker_pool.FleetError(
                f"no node of the Ray cluster at {address} has a core and {bounds.bytes >> 20} MiB for a process "
                "(--memory)"
            )
        self.cores = min(cores or available, available)

    def rows(self, jobs: Sequence[Job], settings: ReplaySettings) -> Iterator[WindowRow]:
        """See `Engine`. Credentials are sent for those stores only in which windows are.

        Raises:
            SourceError: credentials that should be sent cannot be read.
        """
        stores = stores_of(jobs) if self._send_credentials else ()
        credentials = StoreCredentials.from_environment(stores, os.environ)
        actors = _Actors(self._ray, settings.model_dump_json(), credentials, self._bounds)
        yield from worker_pool.WorkerPool(actors, self._bounds).rows(jobs, self.cores)

    def close(self) -> None:
        """Leaves the cluster, or ends it if it was started here."""
        self._ray.shutdown()
