"""The queue of the worker: every job ends once, the room is bounded, the order holds, whatever happens in between."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from coec.calibration.types import Reason
from coec.service.worker.job_queue import (
    BUSY,
    PREFETCHES_WAITING,
    STOPPING,
    SUPERSEDED,
    WAITING,
    WINDOW_WAITS_S,
    JobQueue,
    Lane,
    Ticket,
)
from coec.service.worker.worker_jobs import (
    DEADLINE_S,
    Fate,
    JobOutcome,
    Kind,
    Prefetch,
    RenderedImage,
    Underway,
    WorkerJob,
)

ANSWER = RenderedImage(b"")
"""Stands for any: the queue does not look into answers."""


def a_job(
    subject: str, kind: Kind = Kind.SOLVE, pair: str = "front", live: bool = True, deadline_s: float | None = None
) -> WorkerJob:
    return WorkerJob(kind, pair, subject, {}, lambda _: None, live, deadline_s)


def check(subject: str, pair: str = "front") -> WorkerJob:
    return a_job(subject, Kind.CHECK, pair)


def ends(queue: JobQueue) -> list[tuple[str, Fate, str | None]]:
    """What has ended since the last time: subject, fate, code."""
    return [(job.subject, o.fate, o.reason.code if o.reason else None) for job, o in queue.drain()]


def requested(jobs: Iterable[WorkerJob], attempts: int = 2) -> JobQueue:
    queue = JobQueue(attempts)
    for job in jobs:
        queue.submit(job, 0.0)
    return queue


def begin(queue: JobQueue, now_s: float = 0.0) -> str:
    """Take and send the next one."""
    ticket = queue.take(now_s)
    assert ticket is not None
    queue.sent(now_s)
    return subject_of(ticket)


def subject_of(ticket: Ticket | None) -> str:
    assert ticket is not None
    return ticket.work.subject if isinstance(ticket.work, WorkerJob) else "prefetch"


def test_a_job_ends_with_its_answer_and_the_time_since_it_was_requested() -> None:
    queue = JobQueue(2)
    job = a_job("a")
    queue.submit(job, 10.0)
    assert queue.waiting == {"solve": 1}
    begin(queue, 11.0)
    assert queue.waiting == {}
    progress = queue.in_progress(11.5)
    assert progress is not None
    assert (progress.kind, progress.pair, progress.subject, progress.age_s) == ("solve", "front", "a", 0.5)
    queue.answered(ANSWER, 12.0)
    ((finished, outcome),) = queue.drain()
    assert finished is job
    assert (outcome.fate, outcome.answer, outcome.reason, outcome.elapsed_s) == (Fate.RESULT, ANSWER, None, 2.0)
    assert queue.in_progress(13.0) is None
    assert (queue.outcomes, queue.causes) == ({Fate.RESULT: 1}, {})


def test_numbers_are_never_used_again() -> None:
    queue = requested([a_job("a")], attempts=3)
    numbers = []
    for _ in range(3):
        ticket = queue.take(0.0)
        assert ticket is not None
        numbers.append(ticket.number)
        queue.died("died", 0.0)
    assert len(set(numbers)) == 3


def test_checks_go_first_then_windows_errands_prefetches_the_backlog_and_commissionings() -> None:
    queue = requested(
        [a_job("old", live=False), a_job("picture", Kind.OVERLAY), a_job("baseline", Kind.COMMISSION), a_job("window")]
    )
    queue.prefetch(Prefetch("front", b""))
    queue.submit(check("check"), 0.0)
    order = []
    while (ticket := queue.take(0.0)) is not None:
        order.append(subject_of(ticket))
        queue.sent(0.0)
        queue.answered(None if isinstance(ticket.work, Prefetch) else ANSWER, 0.0)
    assert order == ["check", "window", "picture", "prefetch", "old", "baseline"]


def test_a_window_that_checks_have_retained_waiting_goes_before_them() -> None:
    queue = requested([a_job("window")])
    for second in (0.0, 4.0, 8.0):
        queue.submit(check(f"check {second:.0f}", "rear"), second)
    order = []
    for now_s in (4.0, 8.0, 8.0, 8.0):
        order.append(begin(queue, now_s))
        queue.answered(ANSWER, now_s)
    assert order == ["check 0", "window", "check 4", "check 8"]


@pytest.mark.fault("`commission` while the pair is watched", "checks and windows go before every slice of it")
def test_a_commissioning_goes_on_only_when_nothing_else_waits() -> None:
    queue = requested([a_job("baseline", Kind.COMMISSION)])
    assert queue.commissionings == {"front": None}
    order = []
    for number in range(1, 4):
        order.append(begin(queue))
        for other in (a_job(f"window {number}"), check(f"check {number}"), a_job(f"picture {number}", Kind.OVERLAY)):
            queue.submit(other, 0.0)
        queue.answered(Underway("spread", number, 10), 0.0)
        assert queue.commissionings == {"front": Underway("spread", number, 10)}
        for _ in range(3):
            order.append(begin(queue))
            queue.answered(ANSWER, 0.0)
    order.append(begin(queue))
    queue.answered(ANSWER, 9.0)
    slices = [f"{what} {number}" for number in (1, 2, 3) for what in ("baseline", "check", "window", "picture")]
    assert order == [name if name[:8] != "baseline" else "baseline" for name in slices] + ["baseline"]
    assert queue.commissionings == {}
    assert {job.subject: o.elapsed_s for job, o in queue.drain()}["baseline"] == 9.0


def test_a_pair_has_one_commissioning_and_those_of_several_pairs_follow_each_other() -> None:
    queue = requested([a_job("front", Kind.COMMISSION), a_job("left", Kind.COMMISSION, "left")])
    queue.submit(a_job("waiting already", Kind.COMMISSION), 0.0)
    assert begin(queue) == "front"
    queue.submit(a_job("begun already", Kind.COMMISSION), 0.0)
    queue.answered(Underway("windows", 1, 8), 0.0)
    assert ends(queue) == [("waiting already", Fate.FAILED, "busy"), ("begun already", Fate.FAILED, "busy")]
    assert begin(queue) == "front", "it is ended before the next one begins"
    queue.answered(ANSWER, 0.0)
    queue.submit(a_job("front again", Kind.COMMISSION), 0.0)
    assert [begin(queue), queue.commissionings] == ["left", {"front": None, "left": None}]


def test_a_commissioning_begins_again_when_the_worker_dies_of_something_else() -> None:
    queue = requested([a_job("baseline", Kind.COMMISSION)])
    begin(queue)
    queue.answered(Underway("spread", 4, 10), 0.0)
    queue.submit(check("deadly"), 0.0)
    assert begin(queue) == "deadly"
    queue.died("was ended by signal 9", 0.0)
    assert queue.commissionings == {"front": None}
    assert begin(queue) == "baseline"
    queue.died("was ended by signal 9", 0.0)
    assert ends(queue) == [("deadly", Fate.FAILED, "worker_failed"), ("baseline", Fate.FAILED, "worker_failed")]


def test_a_commissioning_that_never_comes_to_its_end_is_given_up() -> None:
    queue = requested([a_job("baseline", Kind.COMMISSION)])
    begin(queue)
    queue.answered(Underway("spread", 1, 10), 0.0)
    queue.expire(DEADLINE_S[Kind.COMMISSION])
    assert ends(queue) == [("baseline", Fate.LATE, "deadline_passed")]
    assert (queue.commissionings, queue.take(DEADLINE_S[Kind.COMMISSION])) == ({}, None)


def test_the_newest_checks_and_windows_of_a_pair_stay_and_pairs_do_not_push_each_other_out() -> None:
    queue = requested([a_job("w0"), a_job("left-0", pair="left"), a_job("w1"), a_job("w2"), check("other", "left")])
    assert ends(queue) == [("w0", Fate.SUPERSEDED, "superseded")]
    for number in range(WAITING[Lane.CHECK] + 1):
        queue.submit(check(f"c{number}"), 0.0)
    assert ends(queue) == [("c0", Fate.SUPERSEDED, "superseded")]
    assert queue.waiting == {"check": 1 + WAITING[Lane.CHECK], "solve": 3}


@pytest.mark.parametrize(
    ("lane", "kind", "live"), [(Lane.ERRAND, Kind.OVERLAY, True), (Lane.BACKLOG, Kind.SOLVE, False)]
)
def test_of_the_rest_the_oldest_stay(lane: Lane, kind: Kind, live: bool) -> None:
    queue = requested(a_job(str(number), kind, live=live) for number in range(WAITING[lane] + 1))
    assert ends(queue) == [(str(WAITING[lane]), Fate.FAILED, "busy")]
    queue.submit(a_job("left", kind, "left", live), 0.0)
    assert ends(queue) == []


def test_prefetches_are_bounded_and_the_oldest_go() -> None:
    queue = JobQueue(2)
    for number in range(PREFETCHES_WAITING + 3):
        queue.prefetch(Prefetch("front", bytes([number])))
    assert queue.causes == {"prefetch_dropped": 3}
    first = queue.take(0.0)
    assert first is not None
    assert first.work == Prefetch("front", bytes([3]))
    queue.sent(0.0)
    queue.answered(Reason("bad_frame", "dark"), 0.0)
    assert queue.causes == {"prefetch_dropped": 3, "prefetch_refused": 1}
    assert queue.drain() == []


def test_a_window_is_tried_again_until_it_has_had_its_attempts() -> None:
    queue = requested([a_job("a"), a_job("b")], attempts=2)
    assert begin(queue) == "a"
    queue.died("was ended by signal 9", 1.0)
    assert ends(queue) == []
    assert begin(queue) == "a", "in front of the other"
    queue.died("was ended by signal 11", 2.0)
    ((job, outcome),) = queue.drain()
    assert (job.subject, outcome.fate) == ("a", Fate.FAILED)
    assert outcome.reason == Reason(
        "worker_failed", "The worker failed on this window 2 times; the last one was ended by signal 11."
    )
    assert begin(queue) == "b"


def test_a_window_that_could_not_be_sent_has_had_no_attempt() -> None:
    queue = requested([a_job("a")], attempts=1)
    for _ in range(5):
        assert subject_of(queue.take(0.0)) == "a"
        queue.died("broke the connection", 0.0)
    assert ends(queue) == []
    begin(queue)
    queue.died("broke the connection", 0.0)
    assert ends(queue) == [("a", Fate.FAILED, "worker_failed")]


@pytest.mark.parametrize("kind", [Kind.CHECK, Kind.OVERLAY, Kind.COMMISSION, Kind.REGISTER])
def test_other_work_is_done_once_or_not_at_all_and_sent_at_most_twice(kind: Kind) -> None:
    queue = requested([a_job("begun", kind), a_job("unsent", kind, "left")])
    begin(queue)
    queue.died("was ended by signal 9", 0.0)
    assert ends(queue) == [("begun", Fate.FAILED, "worker_failed")]
    assert subject_of(queue.take(0.0)) == "unsent"
    queue.died("broke the connection", 0.0)
    assert ends(queue) == []
    assert subject_of(queue.take(0.0)) == "unsent"
    queue.died("broke the connection", 0.0)
    assert ends(queue) == [("unsent", Fate.FAILED, "worker_failed")]


def test_a_window_that_comes_back_gives_way_to_newer_ones() -> None:
    queue = requested([a_job("a")])
    begin(queue)
    for name in "bc":
        queue.submit(a_job(name), 0.0)
    queue.died("died", 0.0)
    assert ends(queue) == [("a", Fate.SUPERSEDED, "superseded")]


def test_an_errand_that_comes_back_to_a_full_room_has_failed() -> None:
    queue = requested([a_job("a", Kind.OVERLAY)])
    queue.take(0.0)
    for number in range(WAITING[Lane.ERRAND]):
        queue.submit(a_job(str(number), Kind.OVERLAY), 0.0)
    queue.died("broke the connection", 0.0)
    assert ends(queue) == [("a", Fate.FAILED, "worker_failed")]


def test_checks_that_kill_let_windows_go_first_until_one_is_answered() -> None:
    queue = requested([check("c0"), check("c1"), check("c2"), a_job("a"), a_job("b")])
    assert begin(queue) == "c0"
    queue.died("died", 0.0)
    assert begin(queue) == "a"
    queue.answered(ANSWER, 0.0)
    assert begin(queue) == "b"
    queue.answered(ANSWER, 0.0)
    assert begin(queue) == "c1"
    queue.submit(a_job("c"), 0.0)
    queue.answered(Reason("too_few_pairs", "dark"), 0.0)
    assert begin(queue) == "c2"


def test_a_job_is_answered_when_its_deadline_passes() -> None:
    queue = requested([a_job("a", deadline_s=5.0), check("c"), a_job("b")])
    queue.expire(4.9)
    assert ends(queue) == []
    queue.expire(5.0)
    assert ends(queue) == [("a", Fate.LATE, "deadline_passed")]
    queue.expire(DEADLINE_S[Kind.CHECK])
    assert ends(queue) == [("c", Fate.LATE, "deadline_passed")]
    assert queue.take(DEADLINE_S[Kind.SOLVE]) is None, "the deadline of a window has passed, too"
    assert ends(queue) == [("b", Fate.LATE, "deadline_passed")]


@pytest.mark.parametrize("end", ["answer", "death"])
def test_a_job_that_is_late_with_the_worker_is_answered_and_stays_with_it(end: str) -> None:
    queue = requested([a_job("a", deadline_s=5.0), a_job("b")])
    begin(queue)
    queue.expire(6.0)
    ((_, outcome),) = queue.drain()
    assert (outcome.fate, outcome.elapsed_s) == (Fate.LATE, 6.0)
    assert queue.in_progress(7.0) is not None
    if end == "answer":
        queue.answered(ANSWER, 7.0)
        assert queue.causes == {"deadline_passed": 1, "late_answer": 1}
    else:
        queue.died("died", 7.0)
    assert queue.drain() == []
    assert begin(queue, 7.0) == "b", "what is late is not tried again"


def test_at_a_stop_everything_is_answered_and_nothing_more_is_done() -> None:
    queue = requested([check("c"), a_job("a"), a_job("old", live=False), a_job("picture", Kind.OVERLAY)])
    queue.prefetch(Prefetch("front", b""))
    begin(queue)
    queue.stop(1.0)
    assert {(job.subject, o.fate, o.reason) for job, o in queue.drain()} == {
        (subject, Fate.FAILED, STOPPING) for subject in ("c", "a", "old", "picture")
    }
    queue.answered(ANSWER, 2.0)
    queue.submit(a_job("too late"), 3.0)
    queue.prefetch(Prefetch("front", b""))
    assert ends(queue) == [("too late", Fate.FAILED, "stopping")]
    assert queue.take(4.0) is None
    queue.stop(5.0)
    assert queue.drain() == []


def test_the_worker_has_one_thing_at_a_time() -> None:
    queue = requested([a_job("a"), a_job("b")])
    queue.take(0.0)
    with pytest.raises(ValueError, match="the worker is not idle"):
        queue.take(0.0)
    queue.sent(0.0)
    with pytest.raises(ValueError, match="finished without a result"):
        queue.answered(None, 0.0)
    with pytest.raises(ValueError, match="internal error: no job is assigned to the worker"):
        requested([a_job("a")]).sent(0.0)
    with pytest.raises(ValueError, match="internal error: no job is assigned to the worker"):
        requested([a_job("a")]).answered(ANSWER, 0.0)


@pytest.mark.parametrize(
    ("fate", "answer", "reason"),
    [
        (Fate.RESULT, None, None),
        (Fate.RESULT, None, BUSY),
        (Fate.RESULT, ANSWER, BUSY),
        (Fate.FAILED, ANSWER, None),
        (Fate.FAILED, ANSWER, BUSY),
        (Fate.LATE, None, None),
    ],
)
def test_an_outcome_has_either_an_answer_or_a_reason(
    fate: Fate, answer: RenderedImage | None, reason: Reason | None
) -> None:
    with pytest.raises(ValueError, match="either an answer or a reason"):
        JobOutcome(fate, answer, reason, 0.0)


# --- whatever happens in between --------------------------------------------------------------------------------------


@dataclass(eq=False)
class Followed:
    """A job as the model knows it."""

    job: WorkerJob
    requested_s: float
    outcomes: list[JobOutcome] = field(default_factory=list)
    started: int = 0
    unsent: int = 0

    @property
    def lane(self) -> Lane:
        if self.job.kind is Kind.CHECK:
            return Lane.CHECK
        if self.job.kind is Kind.SOLVE:
            return Lane.LIVE if self.job.live else Lane.BACKLOG
        return Lane.COMMISSIONING if self.job.kind is Kind.COMMISSION else Lane.ERRAND

    @property
    def due_s(self) -> float:
        return self.requested_s + self.job.patience_s


class QueueMachine(RuleBasedStateMachine):
    """Drives a queue at random. Beside it a model that is as plain as can be: one list of what waits, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.jobs: list[Followed] = []
        self.waiting: list[Followed] = []
        self.prefetches = 0
        self.hand: Followed | None = None
        self.prefetch_in_hand = False
        self.was_sent = False
        self.check_was_fatal = False
        self.stopped = False
        self.now_s = 0.0

    @initialize(attempts=st.integers(1, 3))
    def build(self, attempts: int) -> None:
        self.attempts = attempts
        self.queue = JobQueue(attempts)

    # --- what may happen --------------------------------------------------------------------------------------------

    @rule(
        kind=st.sampled_from([Kind.SOLVE, Kind.SOLVE, Kind.CHECK, Kind.CHECK, Kind.OVERLAY, Kind.COMMISSION]),
        pair=st.sampled_from(["front", "left"]),
        live=st.booleans(),
        deadline_s=st.sampled_from([None, None, None, 1.0, 3.0, 10.0]),
        times=st.sampled_from([1, 1, 1, 3, 70]),
    )
    def query(self, kind: Kind, pair: str, live: bool, deadline_s: float | None, times: int) -> None:
        for _ in range(times):
            made = Followed(
                a_job(str(len(self.jobs)), kind, pair, live or kind is not Kind.SOLVE, deadline_s), self.now_s
            )
            self.jobs.append(made)
            self.queue.submit(made.job, self.now_s)
            room = [other for other in self.waiting if (other.lane, other.job.pair) == (made.lane, pair)]
            full = len(room) == WAITING[made.lane]
            hand = self.hand
            if made.lane is Lane.COMMISSIONING and hand is not None and hand.lane is made.lane and not hand.outcomes:
                full |= hand.job.pair == pair
            if self.stopped:
                self.expect(made, Fate.FAILED, STOPPING.code)
            elif full and made.lane in (Lane.ERRAND, Lane.BACKLOG, Lane.COMMISSIONING):
                self.expect(made, Fate.FAILED, BUSY.code)
            else:
                if full:
                    self.waiting.remove(room[0])
                    self.expect(room[0], Fate.SUPERSEDED, SUPERSEDED.code)
                self.waiting.append(made)

    @rule()
    def prefetch(self) -> None:
        self.queue.prefetch(Prefetch("front", b""))
        if not self.stopped:
            self.prefetches = min(self.prefetches + 1, PREFETCHES_WAITING)

    @precondition(lambda self: self.is_idle)
    @rule()
    def take(self) -> None:
        ticket = self.queue.take(self.now_s)
        self.let_expire()
        expected = self.next_one()
        self.was_sent = False
        if expected is None and self.prefetch_is_next():
            assert ticket is not None
            assert isinstance(ticket.work, Prefetch)
            self.prefetches -= 1
            self.prefetch_in_hand = True
        elif expected is None:
            assert ticket is None
        else:
            assert ticket is not None
            assert ticket.work is expected.job
            self.waiting.remove(expected)
            self.hand = expected

    @precondition(lambda self: self.is_idle and len(self.waiting) > 0)
    @rule()
    def begin(self) -> None:
        """What happens most."""
        self.take()
        if not self.is_idle:
            self.sent()

    @precondition(lambda self: not self.is_idle and not self.was_sent)
    @rule()
    def sent(self) -> None:
        self.queue.sent(self.now_s)
        self.was_sent = True
        if self.hand is not None:
            self.hand.started += 1

    @precondition(lambda self: not self.is_idle and self.was_sent)
    @rule(refused=st.booleans())
    def answered(self, refused: bool) -> None:
        """By the worker; or the job, half sent, cannot be."""
        reason = Reason("bad_window", "empty")
        job, self.hand = self.hand, None
        if self.prefetch_in_hand:
            self.prefetch_in_hand = False
            self.queue.answered(reason if refused else None, self.now_s)
            return
        assert job is not None
        self.queue.answered(reason if refused else ANSWER, self.now_s)
        if job.lane is Lane.CHECK:
            self.check_was_fatal = False
        if not job.outcomes:
            self.expect(job, Fate.FAILED if refused else Fate.RESULT, reason.code if refused else None)

    @precondition(lambda self: self.hand is not None and self.hand.lane is Lane.COMMISSIONING and self.was_sent)
    @rule()
    def underway(self) -> None:
        """A slice of a commissioning is done."""
        job, self.hand = self.hand, None
        assert job is not None
        self.queue.answered(Underway("spread", 1, 10), self.now_s)
        if not job.outcomes:
            job.unsent = 0
            self.waiting.insert(0, job)

    @rule(why=st.sampled_from(["died", "said what nobody asked"]))
    def died(self, why: str) -> None:
        self.queue.died(why, self.now_s)
        job, self.hand, self.prefetch_in_hand = self.hand, None, False
        if job is None:
            return
        self.check_was_fatal |= job.lane is Lane.CHECK and self.was_sent
        if job.outcomes:
            return
        job.unsent += not self.was_sent
        if job.job.kind is Kind.SOLVE:
            again = job.started < self.attempts or not self.was_sent
        else:
            again = not self.was_sent and job.unsent == 1
        room = [other for other in self.waiting if (other.lane, other.job.pair) == (job.lane, job.job.pair)]
        if again and len(room) < WAITING[job.lane]:
            self.waiting.insert(0, job)
        elif again and job.lane in (Lane.CHECK, Lane.LIVE):
            self.expect(job, Fate.SUPERSEDED, SUPERSEDED.code)
        else:
            self.expect(job, Fate.FAILED, "worker_failed")

    @rule(seconds=st.sampled_from([0.0625, 0.0625, 0.125, 0.25, 0.25, 1.0, 2.5, 30.0, 700.0]), seen=st.booleans())
    def time_passes(self, seconds: float, seen: bool) -> None:
        """Nobody need look at the clock at once."""
        self.now_s += seconds
        if seen:
            self.queue.expire(self.now_s)
            self.let_expire()

    @rule(now=st.sampled_from([False] * 29 + [True]))
    def stop(self, now: bool) -> None:
        """Now and then: afterwards little is left to try."""
        if not now:
            return
        self.queue.stop(self.now_s)
        self.stopped = True
        self.prefetches = 0
        for job in self.waiting:
            self.expect(job, Fate.FAILED, STOPPING.code)
        self.waiting.clear()
        if self.hand is not None and not self.hand.outcomes:
            self.expect(self.hand, Fate.FAILED, STOPPING.code)

    # --- the model --------------------------------------------------------------------------------------------------

    @property
    def is_idle(self) -> bool:
        return self.hand is None and not self.prefetch_in_hand

    def next_one(self) -> Followed | None:
        """The job whose turn it is, if it is one's."""
        order = [Lane.CHECK, Lane.LIVE, Lane.ERRAND]
        window = next((job for job in self.waiting if job.lane is Lane.LIVE), None)
        has_waited = window is not None and self.now_s - window.requested_s > WINDOW_WAITS_S
        if self.check_was_fatal or has_waited:
            order = [Lane.LIVE, Lane.CHECK, Lane.ERRAND]
        if not self.prefetches:
            order += [Lane.BACKLOG, Lane.COMMISSIONING]
        return next((job for lane in order for job in self.waiting if job.lane is lane), None)

    def prefetch_is_next(self) -> bool:
        return self.prefetches > 0

    def let_expire(self) -> None:
        late = [job for job in self.waiting if job.due_s <= self.now_s]
        self.waiting = [job for job in self.waiting if job not in late]
        if self.hand is not None and not self.hand.outcomes and self.hand.due_s <= self.now_s:
            late.append(self.hand)
        for job in late:
            self.expect(job, Fate.LATE, "deadline_passed")

    def expect(self, job: Followed, fate: Fate, code: str | None) -> None:
        """The outcome of this job is there, is this one, and was told when it came to be."""
        self.collect()
        assert len(job.outcomes) == 1, job.job.subject
        (outcome,) = job.outcomes
        assert (outcome.fate, outcome.reason.code if outcome.reason else None) == (fate, code)
        assert outcome.elapsed_s == self.now_s - job.requested_s

    def collect(self) -> None:
        for job, outcome in self.queue.drain():
            self.jobs[int(job.subject)].outcomes.append(outcome)

    # --- what holds -------------------------------------------------------------------------------------------------

    @invariant()
    def every_job_waits_is_with_the_worker_or_has_finished_once(self) -> None:
        self.collect()
        waiting = set(self.waiting)
        for job in self.jobs:
            pending = job in waiting or (job is self.hand and not job.outcomes)
            assert len(job.outcomes) == (0 if pending else 1)
            if job.job.kind is not Kind.COMMISSION:
                assert job.started <= (self.attempts if job.job.kind is Kind.SOLVE else 1)

    @invariant()
    def the_room_is_bounded(self) -> None:
        names = Counter("backlog" if job.lane is Lane.BACKLOG else job.job.kind.value for job in self.waiting)
        assert self.queue.waiting == dict(names)
        rooms = Counter((job.lane, job.job.pair) for job in self.waiting)
        assert all(count <= WAITING[lane] for (lane, _), count in rooms.items())

    @invariant()
    def what_has_finished_is_counted(self) -> None:
        outcomes = [outcome for job in self.jobs for outcome in job.outcomes]
        assert self.queue.outcomes == dict(Counter(outcome.fate for outcome in outcomes))
        codes = Counter(outcome.reason.code for outcome in outcomes if outcome.reason is not None)
        assert {code: self.queue.causes.get(code, 0) for code in codes} == dict(codes)

    def teardown(self) -> None:
        """The end of the service: nobody is left without an answer."""
        self.queue.stop(self.now_s)
        self.collect()
        assert all(len(job.outcomes) == 1 for job in self.jobs)


CHECKS = [HealthCheck.too_slow, HealthCheck.filter_too_much]


@pytest.mark.fault("any sequence of crashes, deadlines and floods of jobs", "every job ends exactly once")
def test_whatever_happens_every_job_ends_once(record_property: Callable[[str, object], None]) -> None:
    short = settings(max_examples=75, stateful_step_count=40, deadline=None, derandomize=True, database=None)
    run_state_machine_as_test(QueueMachine, settings=short)
    record_property("figure", f"{short.max_examples} sequences of {short.stateful_step_count} steps")


@pytest.mark.slow
def test_whatever_happens_every_job_ends_once_in_ten_thousand_sequences() -> None:
    long = settings(
        max_examples=10_000, stateful_step_count=40, deadline=None, database=None, suppress_health_check=CHECKS
    )
    run_state_machine_as_test(QueueMachine, settings=long)
