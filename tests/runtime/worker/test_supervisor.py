"""The supervisor: jobs come back, a worker that crashes, hangs, grows or babbles is replaced, its job tried again."""

from __future__ import annotations

import os
import queue
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from coec.calibration.types import Reason
from coec.config import WorkerConfig
from coec.runtime.worker import link
from coec.runtime.worker.supervisor import (
    BUSY,
    CHECKS_WAITING,
    ERRANDS_WAITING,
    PREFETCHES_WAITING,
    SUPERSEDED,
    Errand,
    Solved,
    SolveJob,
    Worker,
    WorkerState,
)
from fakes import fake_worker_command, wait_until

DEADLINE_S = 30.0
LIMITS = WorkerConfig(timeout_s=1.0, max_memory_bytes=2**28, attempts=2)


@dataclass
class Outcomes:
    """What the supervisor reported, in order."""

    events: queue.SimpleQueue[Solved | tuple[SolveJob, Reason]] = field(default_factory=queue.SimpleQueue)

    def on_failed(self, job: SolveJob, reason: Reason) -> None:
        self.events.put((job, reason))

    def solved(self) -> Solved:
        event = self.events.get(timeout=DEADLINE_S)
        assert isinstance(event, Solved), event
        return event

    def failed(self) -> tuple[SolveJob, Reason]:
        event = self.events.get(timeout=DEADLINE_S)
        assert not isinstance(event, Solved), event
        return event


def job(name: str, pair: str = "front", live: bool = True) -> SolveJob:
    return SolveJob(pair, name, Path("/windows") / name, live)


@contextmanager
def running(fault: str, folder: Path, config: WorkerConfig = LIMITS) -> Iterator[tuple[Worker, Outcomes]]:
    outcomes = Outcomes()
    command = fake_worker_command(fault, folder / "marker")
    worker = Worker(config, "{}", outcomes.events.put, outcomes.on_failed, command)
    worker.start()
    try:
        yield worker, outcomes
    finally:
        worker.request_stop()
        assert worker.thread.join(DEADLINE_S)
        assert worker.thread.failure is None


def test_a_job_comes_back_with_its_result(tmp_path: Path) -> None:
    with running("none", tmp_path) as (worker, outcomes):
        worker.solve(job("a"))
        solved = outcomes.solved()
        assert solved.job == job("a")
        assert solved.result == b"/windows/a"
        wait_until(lambda: worker.status().state is WorkerState.READY, "ready")
        assert worker.status().starts == 1


@pytest.mark.parametrize("fault", ["crash", "hang", "grow", "half"])
def test_after_one_fault_another_worker_solves_the_window(
    tmp_path: Path, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link, "TRANSFER_TIMEOUT_S", 1)
    with running(f"{fault}-once", tmp_path) as (worker, outcomes):
        worker.solve(job("a"))
        assert outcomes.solved().result == b"/windows/a"
        status = worker.status()
        assert status.starts == 2
        assert status.failure is not None
        assert status.failure.code == "worker_failed"


@pytest.mark.parametrize(("fault", "word"), [("crash", "signal 9"), ("hang", "no answer"), ("grow", "memory")])
def test_a_window_that_kills_every_worker_is_given_up_and_the_service_goes_on(
    tmp_path: Path, fault: str, word: str
) -> None:
    with running(fault, tmp_path) as (worker, outcomes):
        worker.solve(job("a"))
        failed, reason = outcomes.failed()
        assert failed == job("a")
        assert reason.code == "worker_failed"
        assert "2 times" in reason.text
        assert word in reason.text
        wait_until(lambda: worker.status().state is WorkerState.READY, "a fresh worker")


def test_an_idle_worker_that_is_killed_is_replaced(tmp_path: Path) -> None:
    with running("none", tmp_path) as (worker, outcomes):
        wait_until(lambda: worker.status().state is WorkerState.READY, "ready")
        first = worker.pid
        assert first is not None
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: worker.status().starts == 2, "a second worker")
        worker.solve(job("a"))
        assert outcomes.solved().result == b"/windows/a"


def test_a_refusal_is_an_answer_not_a_fault(tmp_path: Path) -> None:
    with running("refuse", tmp_path) as (worker, outcomes):
        worker.solve(job("a"))
        assert outcomes.failed() == (job("a"), Reason("bad_window", "empty"))
        assert worker.status().starts == 1


def test_the_newest_windows_of_a_pair_win_and_pairs_do_not_push_each_other_out(tmp_path: Path) -> None:
    outcomes = Outcomes()
    worker = Worker(LIMITS, "{}", outcomes.events.put, outcomes.on_failed, fake_worker_command("none", tmp_path / "m"))
    worker.solve(job("old"))
    worker.solve(job("left-1", "left"))
    worker.solve(job("left-0", "left", live=False))
    worker.solve(job("new"))
    worker.solve(job("newest"))
    failed, reason = outcomes.failed()
    assert (failed, reason.code) == (job("old"), "superseded")
    worker.start()
    try:
        assert [outcomes.solved().job.window_id for _ in range(4)] == ["left-1", "new", "newest", "left-0"]
    finally:
        worker.request_stop()
        assert worker.thread.join(DEADLINE_S)


def test_prefetches_are_bounded_and_give_way_to_windows(tmp_path: Path) -> None:
    outcomes = Outcomes()
    worker = Worker(LIMITS, "{}", outcomes.events.put, outcomes.on_failed, fake_worker_command("none", tmp_path / "m"))
    for _ in range(PREFETCHES_WAITING + 3):
        worker.prefetch("front", bytes(1000))
    assert worker.status().prefetches_dropped == 3
    worker.start()
    try:
        worker.solve(job("a"))
        assert outcomes.solved().job == job("a")
    finally:
        worker.request_stop()
        assert worker.thread.join(DEADLINE_S)


def errand(kind: str, told: queue.SimpleQueue[object], number: int = 0, pair: str = "front") -> Errand:
    return Errand(kind, pair, {"number": number}, told.put, timeout_s=1.0)


def test_an_errand_comes_back_with_its_answer(tmp_path: Path) -> None:
    told: queue.SimpleQueue[object] = queue.SimpleQueue()
    with running("none", tmp_path) as (worker, _):
        worker.run_errand(errand("overlay", told, 7))
        answer = told.get(timeout=DEADLINE_S)
    assert isinstance(answer, dict)
    assert answer["echo"] == {"kind": "overlay", "pair": "front", "number": 7}


def test_of_the_checks_of_a_pair_the_newest_are_taken_and_errands_are_bounded(tmp_path: Path) -> None:
    told: queue.SimpleQueue[object] = queue.SimpleQueue()
    outcomes = Outcomes()
    worker = Worker(LIMITS, "{}", outcomes.events.put, outcomes.on_failed, fake_worker_command("none", tmp_path / "m"))
    worker.check(errand("check", told, 0, "rear"))
    for number in range(1, 2 + CHECKS_WAITING):
        worker.check(errand("check", told, number))
    assert told.get_nowait() is SUPERSEDED
    for number in range(ERRANDS_WAITING):
        worker.run_errand(errand("overlay", told, 100 + number))
    worker.run_errand(errand("overlay", told, 999))
    assert told.get_nowait() is BUSY
    worker.solve(job("a"))
    worker.start()
    try:
        answers = [told.get(timeout=DEADLINE_S) for _ in range(1 + CHECKS_WAITING + ERRANDS_WAITING)]
        assert outcomes.solved().job == job("a")
    finally:
        worker.request_stop()
        assert worker.thread.join(DEADLINE_S)
    numbers = [answer["echo"]["number"] for answer in answers if isinstance(answer, dict)]
    assert numbers == [0, *range(2, 2 + CHECKS_WAITING), *range(100, 100 + ERRANDS_WAITING)]


@pytest.mark.parametrize("fault", ["sick", "sick-refuse"])
def test_an_errand_that_fails_is_answered_and_not_tried_again(tmp_path: Path, fault: str) -> None:
    told: queue.SimpleQueue[object] = queue.SimpleQueue()
    with running(fault, tmp_path) as (worker, outcomes):
        worker.run_errand(errand("overlay", told))
        answer = told.get(timeout=DEADLINE_S)
        assert isinstance(answer, Reason)
        assert answer.code == ("bad_window" if fault == "sick-refuse" else "worker_failed")
        worker.solve(job("a"))
        assert outcomes.solved().job == job("a")


def test_checks_that_kill_do_not_keep_the_worker_from_its_windows(tmp_path: Path) -> None:
    outcomes = Outcomes()
    order: queue.SimpleQueue[str] = queue.SimpleQueue()
    command = fake_worker_command("sick", tmp_path / "m")
    worker = Worker(LIMITS, "{}", lambda solved: order.put(solved.job.window_id), outcomes.on_failed, command)
    for number in range(3):
        worker.check(Errand("check", "front", {"number": number}, lambda _: order.put("check"), timeout_s=1.0))
    worker.solve(job("a"))
    worker.start()
    try:
        assert [order.get(timeout=DEADLINE_S) for _ in range(4)] == ["check", "a", "check", "check"]
    finally:
        worker.request_stop()
        assert worker.thread.join(DEADLINE_S)
    assert worker.status().starts >= 3


def test_a_configuration_that_cannot_work_is_told(tmp_path: Path) -> None:
    with running("unusable", tmp_path) as (worker, _):
        wait_until(lambda: worker.unusable is not None, "the refusal")
        assert worker.unusable == Reason("bad_model", "no such network")


def test_a_worker_that_dies_at_the_start_is_started_again(tmp_path: Path) -> None:
    with running("stillborn", tmp_path) as (worker, _):
        wait_until(lambda: worker.status().starts >= 2, "a second start")
        failure = worker.status().failure
        assert failure is not None
        assert "exit code 3" in failure.text


def test_a_stop_does_not_wait_for_a_solve(tmp_path: Path) -> None:
    with running("hang", tmp_path, WorkerConfig(timeout_s=3600.0)) as (worker, _):
        worker.solve(job("a"))
        wait_until(lambda: worker.status().window_id == "a", "the solve")
        pid = worker.pid
        assert pid is not None
    assert not Path(f"/proc/{pid}").exists()
