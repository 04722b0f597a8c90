"""The engine of this machine: a pool of processes, each on a core of its own."""

from __future__ import annotations

import multiprocessing
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import cast

from coec.adapters.system.cores import one_thread_each
from coec.adapters.system.memory import resident_bytes
from coec.fleet.desk import Desk
from coec.fleet.engines.engine import DEADLINE, PROCESS_DIED, TOO_LARGE, Bounds, FleetError
from coec.fleet.engines.queue import AHEAD, Queue
from coec.fleet.places import Job
from coec.fleet.terms import Terms
from coec.schemas.fleet import WindowRow

LOOK_S = 0.5
"""Time between two checks of the processes' time and memory, s."""

END_S = 5.0
"""Longest wait for a process that was told to end, s."""

READY = ""
"""The first message of a process."""


class _Seat:
    """A process, and the windows that it has."""

    def __init__(self, terms: str) -> None:
        context = multiprocessing.get_context("spawn")
        self.link, theirs = context.Pipe()
        with one_thread_each():
            self.process = context.Process(target=_work, args=(theirs, terms), daemon=True)
            self.process.start()
        theirs.close()  # so that the pipe ends when the process does
        self.has: dict[str, Job] = {}
        self._ready = self._ended = False
        self._told_s = time.monotonic()

    def give(self, job: Job) -> None:
        """Gives the process another window."""
        if not self.has:
            self._told_s = time.monotonic()
        self.has[job.url] = job
        with suppress(OSError):  # the process has ended, which `trouble` will report
            self.link.send(job)

    def hear(self) -> WindowRow | None:
        """The row that has come through the pipe; None if it was something else."""
        try:
            told = self.link.recv()
        except (EOFError, OSError):
            self._ended = True
            return None
        self._told_s = time.monotonic()
        if told == READY:
            self._ready = True
            return None
        row = WindowRow.model_validate_json(told)
        del self.has[row.url]
        return row

    def trouble(self, bounds: Bounds) -> tuple[str, str] | None:
        """Code and text of why the process has to be replaced; None if it has not.

        Raises:
            FleetError: the process ended during its start.
        """
        if self._ended:
            self.process.join(END_S)
            status = self.process.exitcode
            if not self._ready:
                raise FleetError(f"a process for judging windows ended at its start, with status {status}")
            return PROCESS_DIED, f"the process that judged it ended with status {status}"
        if self.has and time.monotonic() - self._told_s > bounds.seconds:
            return DEADLINE, bounds.late
        held = resident_bytes(self.process.pid)
        if held > bounds.bytes:
            return TOO_LARGE, f"its process held {held >> 20} MiB, of {bounds.bytes >> 20} (--memory)"
        return None

    def end(self) -> None:
        """Kills the process, whatever it is doing."""
        self.link.close()
        self.process.kill()
        self.process.join(END_S)


class LocalEngine:
    """Runs a process on each core. A window that ends its process, or takes too long or too much memory, gets a row
    with that error; the others go on."""

    def __init__(self, cores: int, bounds: Bounds) -> None:
        self.cores = cores
        self._bounds = bounds

    def rows(self, jobs: Sequence[Job], terms: Terms) -> Iterator[WindowRow]:
        """See `Engine`."""
        queue, told = Queue(jobs), terms.model_dump_json()
        seats = [_Seat(told) for _ in range(min(self.cores, len(jobs)))]
        try:
            while queue or any(seat.has for seat in seats):
                for seat in seats:
                    while (job := queue.next_for(seat.has.values())) is not None:
                        seat.give(job)
                by_link = {seat.link: seat for seat in seats}
                for link in wait(list(by_link), LOOK_S):
                    row = by_link[cast("Connection", link)].hear()
                    if row is not None:
                        yield row
                for index, seat in enumerate(seats):
                    trouble = seat.trouble(self._bounds)
                    if trouble is not None:
                        seat.end()
                        seats[index] = _Seat(told)
                        yield from queue.give_back(seat.has.values(), *trouble)
        finally:  # also if the caller stops before the end
            for seat in seats:
                seat.end()


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
