"""Processes that misbehave in every way: each window has exactly one row, or the batch stops and says why."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import pytest

from coec.errors import ModelError
from coec.fleet.jobs import Job, StoreError, empty_row, lost_row
from coec.fleet.worker_pool import (
    DEADLINE,
    MAX_LOSSES,
    NODE_LOST,
    PROCESS_DIED,
    START_S,
    FleetError,
    PoolWorker,
    WindowEvaluated,
    WorkerEvent,
    WorkerLimits,
    WorkerPool,
    WorkerStarted,
    WorkerStopped,
)
from coec.schemas.documents import WindowRow

BOUNDS = WorkerLimits(600.0, 2**30)

DIED, LOST = "it ended", "the node that had it was lost"


def jobs(count: int) -> list[Job]:
    return [Job(f"{index:02}.mcap") for index in range(count)]


@dataclass
class Clock:
    """Time passes only when somebody waits."""

    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s


@dataclass(eq=False)
class FakeWorker:
    """A process. `behave` returns what it does when it is polled."""

    number: int
    behave: Callable[[FakeWorker], list[WorkerEvent]]
    started: bool = False
    closed: bool = False
    jobs: deque[Job] = field(default_factory=deque)

    def submit(self, job: Job) -> None:
        assert self.started, "a window was sent to a process that does not run"
        assert not self.closed
        self.jobs.append(job)

    def close(self) -> None:
        assert not self.closed
        self.closed = True


class FakeWorkers:
    """Starts processes, of which each behaves as the list says; further ones as the last."""

    def __init__(self, clock: Clock, *behaviours: Callable[[FakeWorker], list[WorkerEvent]]) -> None:
        self._clock = clock
        self._behaviours = behaviours
        self.all: list[FakeWorker] = []

    def start(self) -> PoolWorker:
        number = len(self.all)
        self.all.append(FakeWorker(number, self._behaviours[min(number, len(self._behaviours) - 1)]))
        return self.all[-1]

    def events(self, workers: Sequence[PoolWorker], timeout_s: float) -> Iterator[WorkerEvent]:
        events = [event for worker in self.all if worker in workers for event in worker.behave(worker)]
        if not events:
            self._clock.now_s += timeout_s
        yield from events


def judge(worker: FakeWorker) -> list[WorkerEvent]:
    """Starts, then judges a window at a time."""
    if not worker.started:
        worker.started = True
        return [WorkerStarted(worker)]
    return [WindowEvaluated(worker, empty_row(worker.jobs.popleft(), {}))] if worker.jobs else []


def never_placed(_: FakeWorker) -> list[WorkerEvent]:
    return []


def fail_alike(code: str, text: str) -> Callable[[FakeWorker], list[WorkerEvent]]:
    """Every window fails at once."""

    def behave(worker: FakeWorker) -> list[WorkerEvent]:
        if not worker.started:
            return judge(worker)
        events: list[WorkerEvent] = [WindowEvaluated(worker, lost_row(job, code, text)) for job in worker.jobs]
        worker.jobs.clear()
        return events

    return behave


def end(*, blame: bool, text: str = DIED) -> Callable[[FakeWorker], list[WorkerEvent]]:
    """Ends as soon as it has windows."""

    def behave(worker: FakeWorker) -> list[WorkerEvent]:
        if not worker.started or not worker.jobs:
            return judge(worker) if not worker.started else []
        return [WorkerStopped(worker, PROCESS_DIED if blame else NODE_LOST, text, blame=blame)]

    return behave


def hang(worker: FakeWorker) -> list[WorkerEvent]:
    return [] if worker.started else judge(worker)


def no_start(worker: FakeWorker) -> list[WorkerEvent]:
    return [WorkerStopped(worker, PROCESS_DIED, "no module named coec")]


def run(
    count: int, cores: int, *behaviours: Callable[[FakeWorker], list[WorkerEvent]], bounds: WorkerLimits = BOUNDS
) -> tuple[dict[str, str | None], FakeWorkers, Clock]:
    """Error code by window (None: judged); no window has two rows."""
    clock = Clock()
    workers = FakeWorkers(clock, *behaviours)
    rows = list(WorkerPool(workers, bounds, clock).rows(jobs(count), cores))
    assert len({row.url for row in rows}) == len(rows)
    assert all(worker.closed for worker in workers.all)
    return {row.url: row.error_code for row in rows}, workers, clock


def all_judged(count: int) -> dict[str, None]:
    return dict.fromkeys(job.url for job in jobs(count))


@pytest.mark.fault("a Ray node is lost for good", "other nodes judge its windows, once each, at once")
def test_windows_of_a_lost_node_go_to_those_that_live_and_wait_for_no_replacement() -> None:
    codes, _, clock = run(9, 2, end(blame=False, text=LOST), judge, never_placed)
    assert codes == all_judged(9)
    assert clock.now_s < 1.0


@pytest.mark.fault("the cluster has no room for some processes", "the others judge all windows")
def test_a_process_that_is_never_placed_holds_no_window() -> None:
    codes, workers, clock = run(9, 4, never_placed, judge, never_placed)
    assert codes == all_judged(9)
    assert not workers.all[0].jobs
    assert clock.now_s < 1.0


@pytest.mark.fault("the cluster has room for no process", "the batch ends with what each process needs")
def test_when_no_process_is_ever_placed_the_batch_ends() -> None:
    clock = Clock()
    with pytest.raises(FleetError, match="1024 MiB"):
        list(WorkerPool(FakeWorkers(clock, never_placed), BOUNDS, clock).rows(jobs(3), 2))
    assert START_S < clock.now_s < START_S + 2.0


def test_a_late_place_is_used() -> None:
    polls = iter(range(1000))

    def late(worker: FakeWorker) -> list[WorkerEvent]:
        return judge(worker) if worker.started or next(polls) > 20 else []

    codes, workers, _ = run(9, 2, hang, late, bounds=WorkerLimits(1.0, 2**30))
    assert workers.all[1].started
    # The first window of the process that hangs is tried again, and hangs nowhere else.
    assert codes == all_judged(9)


@pytest.mark.fault("a window is with several machines, each of which is lost", "a row with its error")
def test_a_window_that_every_machine_is_lost_with_becomes_a_row() -> None:
    codes, workers, _ = run(1, 1, end(blame=False, text=LOST))
    assert codes == {"00.mcap": NODE_LOST}
    assert len([worker for worker in workers.all if worker.started]) == MAX_LOSSES


def test_a_process_that_hangs_costs_its_deadline_and_the_window_is_tried_by_another() -> None:
    codes, _, clock = run(5, 2, hang, judge)
    assert codes == all_judged(5)
    assert BOUNDS.seconds < clock.now_s < BOUNDS.seconds + 2.0
    codes, _, _ = run(1, 1, hang)
    assert codes == {"00.mcap": DEADLINE}


@pytest.mark.fault("late and repeated answers of a process that was given up", "no window has two rows")
def test_late_and_repeated_answers_are_dropped() -> None:
    left: list[WindowRow] = []

    def lost_node(worker: FakeWorker) -> list[WorkerEvent]:
        if not worker.started or not worker.jobs:
            return judge(worker)
        left.extend(empty_row(job, {}) for job in worker.jobs)
        return [
            WorkerStopped(worker, NODE_LOST, LOST, blame=False),
            *(WindowEvaluated(worker, row) for row in left),
            WorkerStopped(worker, NODE_LOST, LOST, blame=False),
        ]

    def stutter(worker: FakeWorker) -> list[WorkerEvent]:
        late: list[WorkerEvent] = [WindowEvaluated(worker, row) for row in left]  # from elsewhere
        return [event for event in judge(worker) for _ in range(2)] + (late if worker.started else [])

    codes, _, _ = run(9, 2, lost_node, stutter)
    assert codes == all_judged(9)


COMMON = [
    pytest.param(StoreError.reply_code, "NoCredentialsError: Unable to locate credentials", "credentials", id="store"),
    pytest.param(ModelError.reply_code, "there is no depth network /opt/net.onnx", "--depth", id="network"),
]


@pytest.mark.fault("no credentials for the store, or no depth network", "the batch stops early and says what to do")
@pytest.mark.parametrize(("code", "text", "advice"), COMMON)
@pytest.mark.parametrize("cores", [1, 4])
def test_a_failure_of_every_window_stops_the_batch_without_rows(cores: int, code: str, text: str, advice: str) -> None:
    clock = Clock()
    workers = FakeWorkers(clock, fail_alike(code, text))
    rows: list[WindowRow] = []
    with pytest.raises(FleetError) as raised:
        rows.extend(WorkerPool(workers, BOUNDS, clock).rows(jobs(61), cores))
    assert rows == []
    assert len(workers.all) == cores
    for part in (text, advice, "--resume", "--keep-going"):
        assert part in str(raised.value)


def test_with_keep_going_every_failure_is_a_row() -> None:
    code = StoreError.reply_code
    codes, _, _ = run(9, 2, fail_alike(code, "away"), bounds=WorkerLimits(600.0, 2**30, alike=None))
    assert codes == {job.url: code for job in jobs(9)}


@pytest.mark.fault("one node of many reaches no store", "it gets no more windows; other nodes judge those that it had")
def test_a_process_that_fails_every_window_does_not_eat_the_batch() -> None:
    codes, workers, _ = run(30, 3, fail_alike(StoreError.reply_code, "away"), judge)
    assert codes == all_judged(30)
    assert workers.all[0].closed


def test_a_store_that_was_away_for_a_moment_costs_no_window() -> None:
    fails = deque([True, False, True, True])

    def blink(worker: FakeWorker) -> list[WorkerEvent]:
        if worker.started and worker.jobs and fails and fails.popleft():
            return [WindowEvaluated(worker, lost_row(worker.jobs.popleft(), StoreError.reply_code, "away"))]
        return judge(worker)

    codes, _, _ = run(9, 1, blink)
    assert codes == all_judged(9)


def test_one_window_that_fails_so_is_no_row_either() -> None:
    with pytest.raises(FleetError, match="1 of 1 windows"):
        run(1, 1, fail_alike(StoreError.reply_code, "away"))


@pytest.mark.fault("a node has no coec, or another version", "it is not used; if none is left, the message says so")
def test_processes_that_cannot_start() -> None:
    with pytest.raises(FleetError, match="no module named coec"):
        run(9, 2, no_start)
    codes, workers, _ = run(9, 2, judge, no_start)
    assert codes == all_judged(9)
    assert len(workers.all) == 2


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.fault("processes end, hang, and are lost with their nodes at random", "each window has one row")
def test_whatever_happens_each_window_has_one_row(seed: int) -> None:
    rng = random.Random(seed)

    def anything(worker: FakeWorker) -> list[WorkerEvent]:
        if not worker.started:
            return judge(worker) if rng.random() < 0.5 else []
        dice = rng.random()
        if dice < 0.05:
            return [WorkerStopped(worker, PROCESS_DIED, DIED)]
        if dice < 0.1:
            return [WorkerStopped(worker, NODE_LOST, LOST, blame=False)]
        if dice < 0.15 and worker.jobs:
            return [WindowEvaluated(worker, lost_row(worker.jobs.popleft(), "bad_window", "rubbish"))]
        return judge(worker) if dice < 0.6 else []

    codes, _, _ = run(40, rng.randrange(1, 6), anything)
    assert codes.keys() == all_judged(40).keys()
