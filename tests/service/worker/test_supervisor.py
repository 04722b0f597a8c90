"""The supervisor: every job has one outcome, a worker that crashes, hangs, grows or says what nobody asked is replaced,
and nothing that it does ends the thread that looks after it."""

from __future__ import annotations

import os
import queue
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame, Reason
from coec.config import CalibrationConfig, WorkerConfig
from coec.io.serialise import result_of
from coec.io.system import ServiceThread
from coec.schemas.message import to_msgpack
from coec.service.api.reply_builders import worker_status_of
from coec.service.worker import child_process, compilation, worker_jobs
from coec.service.worker.child_process import Child, ChildError, Fault
from coec.service.worker.job_queue import BUSY
from coec.service.worker.supervisor import Worker, WorkerState
from coec.service.worker.worker_jobs import (
    Checked,
    Commissioned,
    Cost,
    Fate,
    JobOutcome,
    Kind,
    RenderedImage,
    Solved,
    WorkerJob,
)
from support.estimates import ESTIMATE_RIG, estimate
from support.fake_worker import RELEASE_FILE, RESULT_FILE, SETTINGS_FILE, fake_worker_command, wait_until

DEADLINE_S = 30.0
LIMITS = WorkerConfig(timeout_s=3600.0, max_memory_bytes=2**28, attempts=2)
IMPATIENT = LIMITS.model_copy(update={"timeout_s": 1.5})
"""For workers that give no answer; long enough for those that do, on a busy machine."""

POSE = np.arange(16.0).reshape(4, 4)


@dataclass
class Bench:
    """A worker, and what became of the jobs that it was given."""

    worker: Worker
    folder: Path
    reported: queue.SimpleQueue[tuple[str, JobOutcome]] = field(default_factory=queue.SimpleQueue)
    jobs: list[str] = field(default_factory=list)

    def done(self, name: str) -> Callable[[JobOutcome], None]:
        self.jobs.append(name)
        return lambda outcome: self.reported.put((name, outcome))

    def solve(self, name: str, pair: str = "front", live: bool = True) -> None:
        self.worker.submit(worker_jobs.solve(pair, Path("/windows") / name, name, self.done(name), live))

    def check(self, name: str, pairs: Sequence[FramePair] = ()) -> None:
        self.worker.submit(worker_jobs.check("front", CalibrationConfig(), POSE, pairs, self.done(name)))

    def overlay(self, name: str, deadline_s: float | None = None) -> None:
        self.worker.submit(worker_jobs.overlay("front", Path("/windows/w"), POSE, name, self.done(name), deadline_s))

    def outcome(self) -> tuple[str, JobOutcome]:
        """The next one that is told."""
        return self.reported.get(timeout=DEADLINE_S)

    def answer(self) -> tuple[str, Any]:
        """The next outcome, which is a result: whose, and the id of its window or what else was answered."""
        name, outcome = self.outcome()
        assert outcome.fate is Fate.RESULT, (name, outcome)
        answer = outcome.answer
        return name, answer.result.window_id if isinstance(answer, Solved) else answer

    def failure(self) -> tuple[str, Reason]:
        name, outcome = self.outcome()
        assert outcome.fate is Fate.FAILED, (name, outcome)
        assert outcome.reason is not None
        return name, outcome.reason

    def faults(self) -> dict[Fault, int]:
        return dict(self.worker.status().faults)

    def finish(self) -> None:
        """Stop; whatever happened, the thread has lived, and every job has had one outcome."""
        self.worker.request_stop()
        assert self.worker.thread.join(DEADLINE_S)
        assert self.worker.thread.failure is None
        assert self.worker.status().state is WorkerState.STOPPED
        status = self.worker.status()
        assert sum(status.outcomes.values()) == len(self.jobs)
        assert status.waiting == {}


@contextmanager
def bench(command: Sequence[str], folder: Path, config: WorkerConfig = LIMITS, start: bool = True) -> Iterator[Bench]:
    (folder / RESULT_FILE).write_bytes(to_msgpack(result_of(estimate(1), ESTIMATE_RIG, "test")))
    made = Bench(Worker(config, "{}", command), folder)
    if start:
        made.worker.start()
    try:
        yield made
    finally:
        made.finish()


@contextmanager
def running(fault: str, folder: Path, config: WorkerConfig = LIMITS, at: str = "solve") -> Iterator[Bench]:
    with bench(fake_worker_command(fault, folder, at), folder, config) as made:
        yield made


def limits_for(fault: str) -> WorkerConfig:
    return IMPATIENT if fault in ("hang", "drop") else LIMITS


@contextmanager
def waiting(fault: str, folder: Path, at: str = "solve") -> Iterator[Bench]:
    """Not started yet."""
    with bench(fake_worker_command(fault, folder, at), folder, start=False) as made:
        yield made


# --- another configuration --------------------------------------------------------------------------------------------


def test_jobs_after_another_configuration_are_done_by_it(tmp_path: Path) -> None:
    """In the same process: it is warm, and knows the depth of recent images."""
    with running("none", tmp_path) as it:
        it.overlay("a")
        assert it.answer()[0] == "a"
        pid = it.worker.pid
        it.worker.reconfigure("another")
        it.overlay("b")
        assert it.answer()[0] == "b"
        assert (tmp_path / SETTINGS_FILE).read_text().splitlines() == [f"{pid} {{}}", f"{pid} another"]
        assert it.worker.status().starts == 1


def test_a_worker_that_takes_the_place_of_another_has_the_latest_configuration(tmp_path: Path) -> None:
    with running("crash-once", tmp_path) as it:
        it.worker.reconfigure("another")
        it.solve("a")
        assert it.answer() == ("a", "a")
        assert (tmp_path / SETTINGS_FILE).read_text().splitlines()[-1].endswith(" another")
        assert it.worker.status().starts == 2


# --- what it costs ----------------------------------------------------------------------------------------------------


def test_all_processor_time_is_reported_by_what_it_was_for(tmp_path: Path) -> None:
    """Of a process that is new, of each job before its outcome, and of one that dies with its job."""
    (tmp_path / RESULT_FILE).write_bytes(to_msgpack(result_of(estimate(1), ESTIMATE_RIG, "test")))
    costs: list[Cost] = []
    command = fake_worker_command("crash-once", tmp_path)
    it = Bench(Worker(LIMITS, "{}", command, costs.append), tmp_path)
    it.check("c")
    it.worker.start()
    assert it.answer()[0] == "c"
    assert [cost.kind for cost in costs] == ["start", "idle", "check"]
    assert costs[0].cpu_s > 0.01, "an interpreter has started"
    assert costs[-1].pair == "front"
    it.solve("a")
    assert it.answer() == ("a", "a")
    it.solve("old", live=False)
    assert it.answer() == ("old", "old")
    it.worker.prefetch("rear", b"image")
    wait_until(lambda: costs[-1].kind == "prefetch", "an image")
    it.finish()
    assert costs[-1].pair == "rear"
    assert [cost.kind for cost in costs if cost.kind != "idle"] == [
        "start", "check", "solve", "start", "solve", "backlog", "prefetch",
    ]  # fmt: skip
    assert all(cost.cpu_s >= 0.0 for cost in costs)


# --- jobs come back ---------------------------------------------------------------------------------------------------


def test_each_kind_comes_back_with_its_answer(tmp_path: Path) -> None:
    with running("none", tmp_path) as it:
        it.solve("a")
        assert it.answer() == ("a", "a")
        it.check("c")
        name, checked = it.answer()
        assert (name, type(checked), checked.observation.offset[0]) == ("c", Checked, 0.25)
        assert checked.baseline_not_used == "0 pairs"
        it.overlay("picture")
        assert it.answer() == ("picture", RenderedImage(b"picture"))
        it.worker.submit(
            worker_jobs.commission("front", CalibrationConfig(), POSE, [Path("a"), Path("b")], it.done("rig"))
        )
        name, rig = it.answer()
        assert (name, type(rig), rig.windows, rig.pairs, rig.baseline_hash) == ("rig", Commissioned, 2, 7, "b" * 16)
        np.testing.assert_array_equal(rig.pose, POSE)
        wait_until(lambda: it.worker.status().state is WorkerState.READY, "ready")
        status = it.worker.status()
        assert (status.starts, status.faults, status.losses) == (1, {}, {})
        assert status.outcomes == {Fate.RESULT: 4}
        assert status.rss_bytes > 0


def test_other_work_is_done_between_the_slices_of_a_commissioning(tmp_path: Path) -> None:
    with running("late", tmp_path, at="check") as it:
        it.check("c")
        wait_until(lambda: it.worker.status().state is WorkerState.BUSY, "the check")
        windows = [Path("a"), Path("b"), Path("c")]
        it.worker.submit(worker_jobs.commission("front", CalibrationConfig(), POSE, windows, it.done("rig")))
        it.worker.submit(worker_jobs.commission("front", CalibrationConfig(), POSE, windows, it.done("rig again")))
        assert it.failure() == ("rig again", BUSY)
        assert it.worker.commissioning("front") == "waiting for the worker"
        assert it.worker.commissioning("rear") is None
        assert worker_status_of(it.worker).commissioning == {"front": "waiting for the worker"}
        for name in ("w1", "w2"):
            it.solve(name)
        (tmp_path / RELEASE_FILE).touch()
        assert [it.answer()[0] for _ in range(4)] == ["c", "w1", "w2", "rig"]
        assert (it.worker.commissioning("front"), it.worker.status().starts) == (None, 1)
        assert it.worker.status().outcomes == {Fate.RESULT: 4, Fate.FAILED: 1}


@pytest.mark.fault("the worker is replaced during a commissioning", "it begins again with the next worker")
def test_a_commissioning_outlives_a_worker_that_dies_of_something_else(tmp_path: Path) -> None:
    with waiting("crash-once", tmp_path, at="check") as it:
        it.worker.submit(
            worker_jobs.commission("front", CalibrationConfig(), POSE, [Path("a"), Path("b")], it.done("rig"))
        )
        it.check("c")
        it.worker.start()
        name, reason = it.failure()
        assert (name, reason.code) == ("c", "worker_failed")
        name, rig = it.answer()
        assert (name, rig.windows, it.worker.status().starts) == ("rig", 2, 2)


@pytest.mark.fault("the worker dies of a commissioning", "it ends with the reason; the worker is replaced")
def test_a_commissioning_that_kills_the_worker_has_failed(tmp_path: Path) -> None:
    with running("crash-once", tmp_path, at="commission") as it:
        it.worker.submit(worker_jobs.commission("front", CalibrationConfig(), POSE, [Path("a")], it.done("rig")))
        name, reason = it.failure()
        assert (name, reason.code) == ("rig", "worker_failed")
        it.check("c")
        assert it.answer()[0] == "c"


def test_a_refusal_is_an_answer_not_a_fault(tmp_path: Path) -> None:
    with running("refuse", tmp_path) as it:
        it.solve("a")
        assert it.failure() == ("a", Reason("bad_window", "empty"))
        assert (it.worker.status().starts, it.worker.status().losses) == (1, {"bad_window": 1})


def test_what_comes_first_and_what_is_superseded(tmp_path: Path) -> None:
    with waiting("none", tmp_path) as it:
        for _ in range(11):
            it.worker.prefetch("front", bytes(1000))
        it.solve("old")
        it.solve("left-1", "left")
        it.solve("left-0", "left", live=False)
        it.solve("new")
        it.solve("newest")
        name, outcome = it.outcome()
        assert (name, outcome.fate) == ("old", Fate.SUPERSEDED)
        it.overlay("picture")
        it.check("c")
        status = it.worker.status()
        assert status.waiting == {"solve": 3, "backlog": 1, "overlay": 1, "check": 1}
        assert status.losses == {"superseded": 1, "prefetch_dropped": 3}
        it.worker.start()
        assert [it.answer()[0] for _ in range(6)] == ["c", "left-1", "new", "newest", "picture", "left-0"]


# --- a worker with a fault is replaced --------------------------------------------------------------------------------


IN_A_JOB = {
    "crash": Fault.DIED,
    "half-and-die": Fault.DIED,
    "half": Fault.DISCONNECTED,
    "hang": Fault.TIMED_OUT,
    "drop": Fault.TIMED_OUT,
    "grow": Fault.TOO_LARGE,
    "other": Fault.STRAY_ANSWER,
    "huge": Fault.MALFORMED_ANSWER,
    **dict.fromkeys(
        ["noise", "empty", "no-number", "both", "neither", "list", "other-kind", "wrong-types", "missing"],
        Fault.MALFORMED_ANSWER,
    ),
}


SHORT = ("crash", "half", "hang", "grow", "other", "noise", "wrong-types")
"""One of each kind. What else may be wrong with an answer is tried without a process in test_answers.py."""


@pytest.mark.fault("a worker that crashes, hangs, grows too large or sends rubbish", "another one solves the window")
@pytest.mark.parametrize(
    ("fault", "counted"),
    [pytest.param(*one, marks=() if one[0] in SHORT else pytest.mark.slow) for one in IN_A_JOB.items()],
)
def test_after_one_fault_another_worker_solves_the_window(
    tmp_path: Path, fault: str, counted: Fault, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child_process, "TRANSFER_TIMEOUT_S", 1)
    with running(f"{fault}-once", tmp_path, limits_for(fault)) as it:
        it.solve("a")
        assert it.answer() == ("a", "a")
        status = it.worker.status()
        assert status.starts == 2
        assert status.failure is not None
        assert status.failure.code == "worker_failed"
        assert it.faults() == {counted: 1}


@pytest.mark.parametrize(
    "fault",
    [
        "crash", "empty",
        *(pytest.param(f, marks=pytest.mark.slow) for f in ("half-and-die", "drop", "other", "wrong-types", "missing")),
    ],
)  # fmt: skip
def test_a_check_on_which_the_worker_fails_is_answered_once_and_the_next_one_is_made(
    tmp_path: Path, fault: str
) -> None:
    with running(f"{fault}-once", tmp_path, limits_for(fault), at="check") as it:
        it.check("lost")
        it.check("next")
        name, reason = it.failure()
        assert (name, reason.code) == ("lost", "worker_failed")
        assert it.answer()[0] == "next"
        assert it.faults() == {IN_A_JOB[fault]: 1}


@pytest.mark.fault("a window that kills every worker", "it is given up, and the service goes on")
@pytest.mark.parametrize(
    ("fault", "word"),
    [
        ("crash", "signal 9"),
        pytest.param("drop", "did not reply", marks=pytest.mark.slow),
        pytest.param("other", "another request", marks=pytest.mark.slow),
    ],
)
def test_a_window_that_no_worker_survives_is_given_up_and_the_service_goes_on(
    tmp_path: Path, fault: str, word: str
) -> None:
    with running(fault, tmp_path, limits_for(fault)) as it:
        it.solve("a")
        name, reason = it.failure()
        assert (name, reason.code) == ("a", "worker_failed")
        assert "2 times" in reason.text
        assert word in reason.text
        it.check("c")
        assert it.answer()[0] == "c"


def test_what_is_reported_twice_answers_no_other_query(tmp_path: Path) -> None:
    with running("twice-once", tmp_path, at="overlay") as it:
        for name in "abc":
            it.overlay(name)
        reported = dict(it.outcome() for _ in range(3))
        assert reported["a"].answer == RenderedImage(b"a")
        for name in "bc":
            answer, reason = reported[name].answer, reported[name].reason
            assert answer == RenderedImage(name.encode()) or (reason is not None and reason.code == "worker_failed")
        assert it.faults() == {Fault.STRAY_ANSWER: 1}


@pytest.mark.fault("a worker that talks without being asked", "it is replaced")
def test_a_worker_that_babbles_is_replaced(tmp_path: Path) -> None:
    with running("babble-once", tmp_path) as it:
        wait_until(lambda: it.worker.status().starts == 2, "a second worker")
        it.check("c")
        assert it.answer()[0] == "c"
        assert it.faults() == {Fault.STRAY_ANSWER: 1}


def test_a_worker_that_goes_after_its_answer_takes_no_job_along(tmp_path: Path) -> None:
    """Whether it is seen to have gone before the next job is taken, or is sent one and gives no answer."""
    with running("leave", tmp_path) as it:
        for pair in ("front", "left", "rear"):
            it.solve(pair, pair)
        assert [it.answer() for _ in range(3)] == [(pair, pair) for pair in ("front", "left", "rear")]
        assert set(it.faults()) == {Fault.DIED}
        wait_until(lambda: it.worker.status().starts == 4, "a fresh worker")
        it.check("c")
        assert it.answer()[0] == "c"


def test_an_idle_worker_that_is_killed_is_replaced(tmp_path: Path) -> None:
    with running("none", tmp_path) as it:
        wait_until(lambda: it.worker.status().state is WorkerState.READY, "ready")
        first = it.worker.pid
        assert first is not None
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: it.worker.status().starts == 2, "a second worker")
        it.check("c")
        assert it.answer()[0] == "c"
        assert it.faults() == {Fault.DIED: 1}


def a_pair(stamp_ns: int) -> FramePair:
    image = EncodedImage(ImageFormat.MONO8, 1000, 1000, bytes(1_000_000))
    cloud = np.zeros((10, 3), dtype=np.float32)
    return FramePair(CameraFrame(stamp_ns, "camera", image), LidarFrame(stamp_ns, "lidar", cloud), None)


def test_a_check_that_a_worker_does_not_take_goes_to_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child_process, "TRANSFER_TIMEOUT_S", 1)
    with running("deaf-once", tmp_path) as it:
        it.check("c", [a_pair(number) for number in range(5)])
        name, checked = it.answer()
        assert (name, checked.baseline_not_used) == ("c", "5 pairs")
        assert it.faults() == {Fault.DISCONNECTED: 1}


def test_a_job_that_cannot_be_put_into_bytes_fails_alone(tmp_path: Path) -> None:
    with running("none", tmp_path) as it:
        it.worker.submit(WorkerJob(Kind.OVERLAY, "front", "odd", {"path": object()}, it.done("odd")))
        name, reason = it.failure()
        assert (name, reason.code) == ("odd", "unsendable")
        it.overlay("next")
        assert it.answer() == ("next", RenderedImage(b"next"))
        assert it.faults() == {Fault.UNSENDABLE_JOB: 1}


@pytest.mark.fault("checks that kill every worker", "windows are solved all the same")
def test_checks_that_kill_do_not_keep_the_worker_from_its_windows(tmp_path: Path) -> None:
    with waiting("crash", tmp_path, at="check") as it:
        for name in ("c0", "c1", "c2"):
            it.check(name)
        it.solve("a")
        it.worker.start()
        assert [it.outcome()[0] for _ in range(4)] == ["c0", "a", "c1", "c2"]
        assert it.worker.status().outcomes == {Fate.FAILED: 3, Fate.RESULT: 1}


# --- deadlines, stops, and who asks -----------------------------------------------------------------------------------


def test_an_answer_that_is_late_is_no_fault_and_the_worker_goes_on(tmp_path: Path) -> None:
    with running("late-once", tmp_path, at="overlay") as it:
        it.check("warm")
        assert it.answer()[0] == "warm"
        it.overlay("slow", deadline_s=2.0)
        name, outcome = it.outcome()
        assert (name, outcome.fate) == ("slow", Fate.LATE)
        assert outcome.elapsed_s >= 2.0
        (tmp_path / RELEASE_FILE).touch()
        it.overlay("next")
        assert it.answer() == ("next", RenderedImage(b"next"))
        assert (it.worker.status().starts, it.faults()) == (1, {})
        assert it.worker.status().losses == {"deadline_passed": 1, "late_answer": 1}


@pytest.mark.fault("a worker that hangs", "what waits behind it is answered in time")
def test_what_waits_behind_a_worker_that_hangs_is_answered_in_time(tmp_path: Path) -> None:
    with running("hang", tmp_path) as it:
        it.solve("a")
        wait_until(lambda: it.worker.status().in_progress is not None, "the solve")
        it.overlay("behind", deadline_s=0.1)
        name, outcome = it.outcome()
        assert (name, outcome.fate) == ("behind", Fate.LATE)
        progress = it.worker.status().in_progress
        assert progress is not None
        assert (progress.kind, progress.subject) == ("solve", "a")
        assert progress.age_s > 0.0


def test_a_worker_may_have_less_time_for_one_job_than_for_others(tmp_path: Path) -> None:
    with running("hang-once", tmp_path) as it:
        it.worker.submit(replace(worker_jobs.solve("front", Path("a"), "a", it.done("a")), timeout_s=0.2))
        assert it.answer() == ("a", "a")
        assert it.faults() == {Fault.TIMED_OUT: 1}


@pytest.mark.fault("a worker that cannot start", "its jobs are answered in time")
def test_jobs_for_a_worker_that_cannot_start_are_answered_in_time(tmp_path: Path) -> None:
    with running("stillborn", tmp_path) as it:
        it.overlay("a", deadline_s=0.3)
        name, outcome = it.outcome()
        assert (name, outcome.fate) == ("a", Fate.LATE)
        wait_until(lambda: it.worker.status().starts >= 2, "a second start")
        failure = it.worker.status().failure
        assert failure is not None
        assert "exit code 3" in failure.text


@pytest.mark.fault("the service is stopped while it solves", "it does not wait, and all that waits is answered")
def test_a_stop_does_not_wait_for_a_solve_and_answers_all_that_waits(tmp_path: Path) -> None:
    with running("hang", tmp_path) as it:
        it.solve("a")
        wait_until(lambda: it.worker.status().in_progress is not None, "the solve")
        it.solve("b")
        it.check("c")
        pid = it.worker.pid
        it.worker.request_stop()
        reported = {it.outcome()[0]: None for _ in range(3)}
        assert set(reported) == {"a", "b", "c"}
        it.solve("too late")
        name, reason = it.failure()
        assert (name, reason.code) == ("too late", "stopping")
    assert not Path(f"/proc/{pid}").exists()


def test_a_stop_before_the_start_answers_all_that_waits(tmp_path: Path) -> None:
    it = Bench(Worker(LIMITS, "{}", fake_worker_command("none", tmp_path)), tmp_path)
    it.solve("a")
    it.worker.request_stop()
    assert it.failure() == ("a", Reason("stopping", "The service is stopping."))


def test_whoever_fails_to_take_an_outcome_harms_nobody_else(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def fail(_: JobOutcome) -> None:
        raise ZeroDivisionError("nobody is at home")

    with running("none", tmp_path) as it:
        it.jobs.append("a")
        it.worker.submit(worker_jobs.overlay("front", Path("a"), POSE, "a", fail))
        it.overlay("b")
        assert it.answer() == ("b", RenderedImage(b"b"))
        assert it.worker.status().losses == {"done_raised": 1}
        assert it.worker.status().outcomes == {Fate.RESULT: 2}
    assert "nobody is at home" in caplog.text


def test_an_outcome_is_reported_without_a_lock(tmp_path: Path) -> None:
    """Whoever is told may ask for more, and so may others while he is told."""
    statuses: queue.SimpleQueue[WorkerState] = queue.SimpleQueue()
    with running("none", tmp_path) as it:

        def reported(_: JobOutcome) -> None:
            asker = ServiceThread("asker", lambda _: statuses.put(it.worker.status().state))
            asker.start()
            assert asker.join(DEADLINE_S)
            it.overlay("next")

        it.jobs.append("first")
        it.worker.submit(worker_jobs.overlay("front", Path("a"), POSE, "first", reported))
        assert it.answer() == ("next", RenderedImage(b"next"))
    assert statuses.get_nowait() in (WorkerState.BUSY, WorkerState.READY)


# --- kernels that are compiled ----------------------------------------------------------------------------------------


def compiling(it: Bench) -> tuple[int, int] | None:
    """How many kernels are there, of how many; None if none are being compiled."""
    reported = it.worker.status().compiling
    return None if reported is None else (reported.done, reported.total)


@pytest.mark.fault(
    "a first start on a busy machine: kernels are compiled for minutes",
    "no time limit counts it, no worker is replaced, status says how far it is; windows wait",
)
def test_no_time_limit_counts_the_time_of_compiling(tmp_path: Path) -> None:
    with running("compiling", tmp_path) as it:
        it.solve("a")
        wait_until(lambda: compiling(it) is not None, "the compilation")
        it.overlay("picture", deadline_s=2.0)
        wait_until(lambda: it.worker.compiled_s > 2.5, "longer than the deadline")
        assert compiling(it) == (0, 3)
        assert it.worker.warms_up
        status = worker_status_of(it.worker)
        assert (status.state, status.restarts, status.waiting) == ("starting", 0, {"solve": 1, "overlay": 1})
        assert status.compiling is not None
        assert status.compiling.elapsed_s > 2.5
        (tmp_path / RELEASE_FILE).touch()
        assert {it.answer()[0] for _ in range(2)} == {"a", "picture"}
        assert (it.worker.status().starts, it.faults(), compiling(it)) == (1, {}, None)
        assert not it.worker.warms_up


def test_a_check_is_refused_while_a_worker_that_starts_compiles_kernels(tmp_path: Path) -> None:
    with running("compiling", tmp_path) as it:
        wait_until(lambda: it.worker.warms_up, "the compilation")
        it.check("early")
        name, reason = it.failure()
        assert (name, reason.code) == ("early", "compiling_kernels")
        assert "0 of 3" in reason.text
        (tmp_path / RELEASE_FILE).touch()
        wait_until(lambda: it.worker.status().state is WorkerState.READY, "ready")
        it.check("c")
        assert it.answer()[0] == "c"


@pytest.mark.fault("a compilation of kernels that makes no progress", "the worker is replaced, after a generous time")
def test_a_worker_that_makes_no_progress_in_compiling_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation, "STALLED_S", 0.3)
    with running("compiling-stuck-once", tmp_path) as it:
        it.solve("a")
        assert it.answer() == ("a", "a")
        assert it.faults() == {Fault.TIMED_OUT: 1}
        failure = it.worker.status().failure
        assert failure is not None
        assert "compilation of its kernels" in failure.text


def test_a_job_for_which_kernels_are_compiled_has_its_time_besides(tmp_path: Path) -> None:
    with running("compiles-once", tmp_path, IMPATIENT) as it:
        it.solve("a")
        wait_until(lambda: it.worker.compiled_s > IMPATIENT.timeout_s + 0.5, "longer than a job may take")
        assert not it.worker.warms_up, "checks wait, as they do for any job"
        (tmp_path / RELEASE_FILE).touch()
        assert it.answer() == ("a", "a")
        assert it.worker.status().starts == 1


def test_kernels_that_no_check_needs_are_compiled_when_nothing_else_waits(tmp_path: Path) -> None:
    with waiting("compiling-later", tmp_path) as it:
        it.check("c")
        it.worker.start()
        assert it.answer()[0] == "c"
        wait_until(lambda: compiling(it) == (2, 3), "the compilation")
        it.check("next")
        (tmp_path / RELEASE_FILE).touch()
        assert it.answer()[0] == "next"
        wait_until(lambda: compiling(it) is None, "the end of it")
        assert (it.worker.status().starts, it.faults()) == (1, {})


# --- the start --------------------------------------------------------------------------------------------------------


def test_a_configuration_that_cannot_work_is_reported(tmp_path: Path) -> None:
    with running("unusable", tmp_path) as it:
        wait_until(lambda: it.worker.unusable is not None, "the refusal")
        assert it.worker.unusable == Reason("bad_model", "no such network")
        wait_until(lambda: Fault.UNUSABLE in it.faults(), "the count")


def test_a_worker_that_talks_nonsense_at_the_start_is_replaced(tmp_path: Path) -> None:
    with running("dumb-once", tmp_path) as it:
        it.solve("a")
        assert it.answer() == ("a", "a")
        assert it.faults() == {Fault.MALFORMED_ANSWER: 1}


def test_a_program_that_is_not_there_is_a_failure_until_it_is(tmp_path: Path) -> None:
    program = tmp_path / "program"
    _, *arguments = fake_worker_command("none", tmp_path)
    with bench([str(program), *arguments], tmp_path) as it:
        it.solve("a")
        wait_until(lambda: it.faults().get(Fault.NOT_STARTED, 0) > 0, "the failure")
        failure = it.worker.status().failure
        assert failure is not None
        assert "could not be started" in failure.text
        assert it.worker.status().state is WorkerState.STARTING
        script = tmp_path / "script"
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
        script.chmod(0o755)
        script.rename(program)
        assert it.answer() == ("a", "a")


def test_a_worker_without_a_socket_is_a_failure_until_there_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right, failed = child_process.Link.pair, list[int]()

    def fail_once() -> Any:
        if failed:
            return right()
        failed.append(1)
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(child_process.Link, "pair", fail_once)
    with running("none", tmp_path) as it:
        it.solve("a")
        assert it.answer() == ("a", "a")
        assert it.faults() == {Fault.NOT_STARTED: 1}


def test_a_program_that_cannot_be_run_leaves_no_socket_behind(tmp_path: Path) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        with pytest.raises(ChildError, match="could not be started"):
            Child([str(tmp_path / "nowhere")], LIMITS)
    assert len(list(Path("/proc/self/fd").iterdir())) == before
