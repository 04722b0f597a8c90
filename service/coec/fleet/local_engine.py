"""The engine of this machine: a pool of processes, each on a core of its own."""

import multiprocessing
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import cast

from coec.fleet import worker_pool
from coec.fleet.evaluator import ReplaySettings, WindowEvaluator
from coec.fleet.jobs import Job
from coec.io.system import one_thread_each, resident_bytes
from coec.schemas.fleet import WindowRow

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
        """See `Workers`."""
        return _Process(self._settings)

    def events(self, workers: Sequence[worker_pool.PoolWorker], timeout_s: float) -> Iterator[worker_pool.WorkerEvent]:
        """See `Workers`."""
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
