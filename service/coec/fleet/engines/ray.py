"""The engine of a Ray cluster: an existing one (`RAY_ADDRESS`, or started on this machine), else a fresh one.

Each process is an actor on one core. It declares the memory that a window may take, so that the cluster places no more
actors than it can hold.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Generator, Iterator, Sequence
from typing import Any

from coec.adapters.system.cores import ONE_THREAD
from coec.errors import SourceError
from coec.fleet.engines.engine import DEADLINE, PROCESS_DIED, Bounds, FleetError
from coec.fleet.engines.queue import AHEAD, Queue
from coec.fleet.places import Job
from coec.fleet.terms import Terms
from coec.schemas.fleet import WindowRow

LOOK_S = 1.0
"""Time between two checks of how long windows take, s."""


class _Judge:
    """Runs on a node of the cluster, which has coec installed."""

    def __init__(self, terms: str) -> None:
        from coec.fleet.desk import Desk  # only the nodes need what calibrates

        self._desk = Desk(Terms.model_validate_json(terms))

    def row(self, job: Job) -> str:
        """The row of a window, as JSON. For several threads."""
        return self._desk.row(job).model_dump_json()


class _Seat:
    """An actor and the windows that it has, by the reference of their future row."""

    def __init__(self, actor: Any) -> None:
        self.actor = actor
        self.has: dict[Any, Job] = {}
        self.told_s = time.monotonic()

    def give(self, job: Job) -> None:
        """Gives the actor another window."""
        if not self.has:
            self.told_s = time.monotonic()
        self.has[self.actor.row.remote(job)] = job


class RayEngine:
    """Judges windows on a Ray cluster."""

    def __init__(self, cores: int | None, bounds: Bounds) -> None:
        """`cores`: how many cores are used at most; None: all of the cluster.

        Raises:
            SourceError: Ray is not installed.
            FleetError: there is no cluster, and none can be started.
        """
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # otherwise Ray reports to its vendor
        try:
            import ray
        except ImportError as error:
            raise SourceError("the engine `ray` needs the optional extra `ray`: pip install 'coec[ray]'") from error
        self._ray = ray
        self._bounds = bounds
        try:
            ray.init(
                ignore_reinit_error=True,
                include_dashboard=False,
                log_to_driver=False,
                logging_level=logging.ERROR,
                runtime_env={"env_vars": dict(ONE_THREAD)},
            )
            there = int(ray.cluster_resources().get("CPU", 0.0))
        except Exception as error:  # of Ray, of the system, or of a library in between
            raise FleetError(f"no Ray cluster: {type(error).__name__}: {error}") from error
        self.cores = max(min(cores or there, there), 1)

    def rows(self, jobs: Sequence[Job], terms: Terms) -> Iterator[WindowRow]:
        """See `Engine`."""
        queue, told = Queue(jobs), terms.model_dump_json()
        seats = [_Seat(self._actor(told)) for _ in range(min(self.cores, len(jobs)))]
        try:
            while queue or any(seat.has for seat in seats):
                for seat in seats:
                    while (job := queue.next_for(seat.has.values())) is not None:
                        seat.give(job)
                done, _ = self._ray.wait([row for seat in seats for row in seat.has], timeout=LOOK_S)
                for index, seat in enumerate(seats):
                    trouble = yield from self._heard(seat, done)
                    if trouble is not None:
                        self._ray.kill(seat.actor)
                        seats[index] = _Seat(self._actor(told))
                        yield from queue.give_back(seat.has.values(), *trouble)
        finally:  # also if the caller stops before the end
            for seat in seats:
                self._ray.kill(seat.actor)

    def _heard(self, seat: _Seat, done: Sequence[Any]) -> Generator[WindowRow, None, tuple[str, str] | None]:
        """Yields the finished rows of a process. Returns code and text of why it has to be replaced, or None."""
        for row in [row for row in done if row in seat.has]:
            try:
                document = self._ray.get(row)
            except self._ray.exceptions.RayError as error:
                return PROCESS_DIED, f"the process that judged it ended: {type(error).__name__}"
            seat.told_s = time.monotonic()
            del seat.has[row]
            yield WindowRow.model_validate_json(document)
        late = seat.has and time.monotonic() - seat.told_s > self._bounds.seconds
        return (DEADLINE, self._bounds.late) if late else None

    def _actor(self, terms: str) -> Any:
        judge = self._ray.remote(_Judge)
        return judge.options(num_cpus=1, memory=self._bounds.bytes, max_concurrency=AHEAD).remote(terms)
