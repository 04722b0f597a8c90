"""The engine of this machine: a pool of processes, each on a core of its own."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import cast

from coec.adapters.system.cores import one_thread_each
from coec.adapters.system.memory import resident_bytes
from coec.fleet.desk import Desk
from coec.fleet.engines.engine import PROCESS_DIED, TOO_LARGE, Bounds
from coec.fleet.engines.pool import Ended, Event, Judged, Pool, Started, Worker
from coec.fleet.engines.queue import AHEAD
from coec.fleet.places import Job
from coec.fleet.terms import Terms
from coec.schemas.fleet import WindowRow

END_S = 5.0
"""Longest wait for a process that was told to end, s."""

READY = ""
"""The first message of a process."""


class _Process:
    """A process on this machine."""

    def __init__(self, terms: str) -> None:
        context = multiprocessing.get_context("spawn")
        self.link, theirs = context.Pipe()
        with one_thread_each():
            self._process = context.Process(target=_work, args=(theirs, terms), daemon=True)
            self._process.start()
        theirs.close()  # so that the pipe ends when the process does
        self.ready = False

    def submit(self, job: Job) -> None:
        """See `Worker`."""
        with suppress(OSError):  # the process has ended, which `received` will report
            self.link.send(job)

    def received(self) -> Event:
        """What has come through the pipe."""
        try:
            message = self.link.recv()
        except (EOFError, OSError):
            self._process.join(END_S)
            status = self._process.exitcode
            if not self.ready:
                return Ended(
                    self, PROCESS_DIED, f"a process for judging windows ended at its start, with status {status}"
                )
            return Ended(self, PROCESS_DIED, f"the process that judged it ended with status {status}")
        if message == READY:
            self.ready = True
            return Started(self)
        return Judged(self, WindowRow.model_validate_json(message))

    @property
    def resident_bytes(self) -> int:
        """Memory that it holds, bytes."""
        return resident_bytes(self._process.pid)

    def close(self) -> None:
        """See `Worker`."""
        self.link.close()
        self._process.kill()
        self._process.join(END_S)


class _Processes:
    """Starts processes on this machine, and bounds their memory."""

    def __init__(self, terms: str, bounds: Bounds) -> None:
        self._terms = terms
        self._bounds = bounds

    def start(self) -> Worker:
        """See `Workers`."""
        return _Process(self._terms)

    def events(self, workers: Sequence[Worker], timeout_s: float) -> Iterator[Event]:
        """See `Workers`."""
        processes = cast("Sequence[_Process]", workers)
        for process in processes:
            held = process.resident_bytes if process.ready else 0
            if held > self._bounds.bytes:
                text = f"its process held {held >> 20} MiB, of {self._bounds.bytes >> 20} (--memory)"
                yield Ended(process, TOO_LARGE, text)
        by_link = {process.link: process for process in processes if not process.link.closed}
        for link in wait(list(by_link), timeout_s):
            yield by_link[cast("Connection", link)].received()


class LocalEngine:
    """Runs a process on each core. A window that ends its process, or takes too long or too much memory, gets a row
    with that error; the others go on."""

    def __init__(self, cores: int, bounds: Bounds) -> None:
        self.cores = cores
        self._bounds = bounds

    def rows(self, jobs: Sequence[Job], terms: Terms) -> Iterator[WindowRow]:
        """See `Engine`."""
        yield from Pool(_Processes(terms.model_dump_json(), self._bounds), self._bounds).rows(jobs, self.cores)

    def close(self) -> None:
        """See `Engine`."""


# --- in the process -------------------------------------------------------------------------------------------------


def _work(link: Connection, terms: str) -> None:
    """Takes windows until none come any more. Each thread has one window, and one thread at a time solves."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which decides when this process ends
    desk = Desk(Terms.model_validate_json(terms))
    link.send(READY)
    taking, telling = threading.Lock(), threading.Lock()

    def take() -> None:
        with suppress(EOFError, OSError):  # the parent has gone
            while True:
                with taking:
                    job = link.recv()
                told = desk.row(job).model_dump_json()
                with telling:
                    link.send(told)

    threads = [threading.Thread(target=take, name=f"judge-{index}") for index in range(AHEAD)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
