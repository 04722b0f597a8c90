"""The queue of jobs for the worker, and how each of them ends: a state machine without a thread, a process or a clock.

Every job that comes in goes out exactly once, with its outcome. The number of waiting jobs is bounded per pair, so that
pairs do not push each other out. If there are too many, the newest checks and live windows stay, and the oldest of the
rest.

A commissioning takes minutes and is done in slices: it comes back after each and goes on only when nothing else waits.
"""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from coec.calibration.types import Reason
from coec.service.worker.worker_jobs import PREFETCH, Answer, Fate, JobOutcome, Kind, Prefetch, Underway, WorkerJob


class Lane(Enum):
    """Where a job waits."""

    CHECK = "check"
    LIVE = "live"
    LIDARS = "lidars"
    ERRAND = "errand"
    BACKLOG = "backlog"
    COMMISSIONING = "commissioning"


WAITING = {Lane.CHECK: 4, Lane.LIVE: 2, Lane.LIDARS: 2, Lane.ERRAND: 8, Lane.BACKLOG: 64, Lane.COMMISSIONING: 1}
"""How many jobs may wait, per pair. Checks, windows and registrations of LiDARs are those of this run; the service
waits for their answers before it asks more, so these limits matter only if the worker does not answer. Errands are
pictures, the backlog is unsolved windows of earlier runs. A pair has one commissioning, waiting or begun."""

SUPERSEDING = frozenset({Lane.CHECK, Lane.LIVE, Lane.LIDARS})
"""Lanes in which the newest job is worth most."""

PREFETCHES_WAITING, PREFETCH_BYTES_WAITING = 8, 32 * 2**20
"""How many images may wait for early inference, and their bytes. The solve itself infers those that find no room."""

WINDOW_WAITS_S = 5.0
"""How long checks may keep a window of this run from the worker, s: the usual time between two checks of a pair. While
a window waits, its pair is not looked at."""

SUPERSEDED = Reason("superseded", "A newer job of the pair arrived before the worker was free.")
BUSY = Reason("busy", "Too many jobs wait for the worker; ask again in a moment.")
STOPPING = Reason("stopping", "The service is stopping.")

WORKER_FAILED = "worker_failed"
"""Code of the reason when the worker failed on a job."""


@dataclass(frozen=True, slots=True)
class Ticket:
    """The next work for the worker, under a number that no other ticket has had."""

    number: int
    work: WorkerJob | Prefetch


@dataclass(frozen=True, slots=True)
class InProgress:
    """The work that the worker has, and since how long, s. `kind` is a kind of job or `prefetch`."""

    kind: str
    pair: str
    subject: str
    age_s: float


@dataclass(slots=True, eq=False)
class _Entry:
    """A job on its way. `attempts`: how often a worker had it; `returned`: sending it has failed once; `reached`: how
    far a commissioning is that has been begun."""

    job: WorkerJob
    submitted_s: float
    attempts: int = 0
    returned: bool = False
    settled: bool = False
    reached: Underway | None = None

    @property
    def deadline_s(self) -> float:
        return self.submitted_s + self.job.patience_s


@dataclass(slots=True, eq=False)
class _InHand:
    work: _Entry | Prefetch
    taken_s: float
    sent: bool = False


class JobQueue:
    """The jobs that wait and the one that the worker has. Not for several threads at once. Times are of one steady
    clock, s. Ended jobs stay in the outbox until `drain`."""

    def __init__(self, attempts: int) -> None:
        """`attempts`: how many workers may fail on one window before it is given up."""
        self._attempts = attempts
        self._lanes: dict[Lane, deque[_Entry]] = {lane: deque() for lane in Lane}
        self._prefetches: deque[Prefetch] = deque()
        self._in_hand: _InHand | None = None
        self._outbox: list[tuple[WorkerJob, JobOutcome]] = []
        self._number = 0
        self._check_was_fatal = False
        self._stopped = False
        self._outcomes: Counter[Fate] = Counter()
        self._causes: Counter[str] = Counter()

    # --- from those who ask -----------------------------------------------------------------------------------------

    def submit(self, job: WorkerJob, now_s: float) -> None:
        """Takes in a job."""
        entry = _Entry(job, now_s)
        if self._stopped:
            self._end(entry, Fate.FAILED, STOPPING, now_s)
            return
        lane = _lane_of(job)
        if self._is_full(lane, job.pair) or (lane is Lane.COMMISSIONING and job.pair in self.commissionings):
            if lane not in SUPERSEDING:
                self._end(entry, Fate.FAILED, BUSY, now_s)
                return
            oldest = next(each for each in self._lanes[lane] if each.job.pair == job.pair)
            self._lanes[lane].remove(oldest)
            self._end(oldest, Fate.SUPERSEDED, SUPERSEDED, now_s)
        self._lanes[lane].append(entry)

    def refuse(self, job: WorkerJob, reason: Reason, now_s: float) -> None:
        """Answers a job at once with the reason why it is not taken in."""
        self._end(_Entry(job, now_s), Fate.FAILED, reason, now_s)

    def prefetch(self, prefetch: Prefetch) -> None:
        """Takes in an image; if there is no room, the oldest image is dropped."""
        if self._stopped:
            return
        self._prefetches.append(prefetch)
        while len(self._prefetches) > PREFETCHES_WAITING or (
            len(self._prefetches) > 1 and sum(len(one.frame) for one in self._prefetches) > PREFETCH_BYTES_WAITING
        ):
            self._prefetches.popleft()
            self._causes["prefetch_dropped"] += 1

    # --- from the worker's side -------------------------------------------------------------------------------------

    def take(self, now_s: float) -> Ticket | None:
        """Takes out the next work, if any waits. It is in hand until it is `answered` or the worker `died`.

        Raises:
            ValueError: some work is in hand already.
        """
        if self._in_hand is not None:
            raise ValueError("internal error: the worker is not idle")
        self.expire(now_s)
        work = self._next(now_s)
        if work is None:
            return None
        self._number += 1
        self._in_hand = _InHand(work, now_s)
        return Ticket(self._number, work.job if isinstance(work, _Entry) else work)

    def sent(self, now_s: float) -> None:
        """The work in hand has reached the worker and counts as begun from now on."""
        hand = self._hand()
        hand.sent, hand.taken_s = True, now_s
        if isinstance(hand.work, _Entry):
            hand.work.attempts += 1

    def answered(self, answer: Answer | Underway | Reason | None, now_s: float) -> None:
        """The work in hand has ended, with an answer or with the reason why there is none. None answers a prefetch. A
        job that is `Underway` goes back to the front of its lane."""
        work = self._hand().work
        self._in_hand = None
        if isinstance(work, Prefetch):
            self._causes["prefetch_refused"] += isinstance(answer, Reason)
            return
        if answer is None:
            raise ValueError("internal error: a job finished without a result")
        self._check_was_fatal &= work.job.kind is not Kind.CHECK
        if work.settled:
            self._causes["late_answer"] += 1
        elif isinstance(answer, Underway):
            work.reached, work.returned = answer, False
            self._lanes[_lane_of(work.job)].appendleft(work)
        else:
            self._end(work, Fate.FAILED if isinstance(answer, Reason) else Fate.RESULT, answer, now_s)

    def died(self, why: str, now_s: float) -> None:
        """The worker is being replaced because it `why` (a verb and what follows). If the work in hand had not reached
        it, the work goes back to the front, a window always, other work once. If it had, a window goes back until its
        attempts are used up, and other work has failed. A commissioning that waits for its next slice begins again with
        the next worker."""
        hand, self._in_hand = self._in_hand, None
        for waiting in self._lanes[Lane.COMMISSIONING]:
            waiting.reached = None
        if hand is None or isinstance(hand.work, Prefetch):
            return
        entry, kind = hand.work, hand.work.job.kind
        self._check_was_fatal |= hand.sent and kind is Kind.CHECK
        if entry.settled:
            return
        entry.reached = None
        reason = Reason(WORKER_FAILED, f"The worker {why}.")
        if kind is Kind.SOLVE:
            again = not hand.sent or entry.attempts < self._attempts
            if entry.attempts > 1:
                text = f"The worker failed on this window {entry.attempts} times; the last one {why}."
                reason = Reason(WORKER_FAILED, text)
        else:
            again, entry.returned = not hand.sent and not entry.returned, True
        if again:
            self._put_back(entry, reason, now_s)
        else:
            self._end(entry, Fate.FAILED, reason, now_s)

    # --- from both --------------------------------------------------------------------------------------------------

    def expire(self, now_s: float) -> None:
        """Time has passed: answers jobs whose deadline has come. A job that the worker has stays in hand."""
        for waiting in self._lanes.values():
            for entry in [each for each in waiting if each.deadline_s <= now_s]:
                waiting.remove(entry)
                self._end_late(entry, now_s)
        entry_in_hand = self._in_hand.work if self._in_hand else None
        if isinstance(entry_in_hand, _Entry) and not entry_in_hand.settled and entry_in_hand.deadline_s <= now_s:
            self._end_late(entry_in_hand, now_s)

    def stop(self, now_s: float) -> None:
        """Ends all work: answers all jobs that wait, are in hand or come later as `stopping`."""
        self._stopped = True
        self._prefetches.clear()
        for waiting in self._lanes.values():
            while waiting:
                self._end(waiting.popleft(), Fate.FAILED, STOPPING, now_s)
        entry = self._in_hand.work if self._in_hand else None
        if isinstance(entry, _Entry) and not entry.settled:
            self._end(entry, Fate.FAILED, STOPPING, now_s)

    def drain(self) -> list[tuple[WorkerJob, JobOutcome]]:
        """Takes out the jobs that have ended since the last call, in order."""
        finished, self._outbox = self._outbox, []
        return finished

    # --- figures ----------------------------------------------------------------------------------------------------

    @property
    def outcomes(self) -> Mapping[Fate, int]:
        """Number of ended jobs, by how they ended."""
        return dict(self._outcomes)

    @property
    def causes(self) -> Mapping[str, int]:
        """Number of jobs without a result, by the code of their reason. `prefetch_dropped` and `prefetch_refused` count
        images that were not inferred ahead, `late_answer` answers that came after the job's deadline."""
        return {cause: count for cause, count in self._causes.items() if count}

    @property
    def waiting(self) -> Mapping[str, int]:
        """Number of waiting jobs by kind; windows of an earlier run are under `backlog`."""
        names = (
            "backlog" if lane is Lane.BACKLOG else entry.job.kind.value
            for lane, entries in self._lanes.items()
            for entry in entries
        )
        return dict(Counter(names))

    @property
    def commissionings(self) -> Mapping[str, Underway | None]:
        """How far the commissioning of each pair is that has one; None: not begun."""
        entries = [*self._lanes[Lane.COMMISSIONING]]
        in_hand = self._in_hand.work if self._in_hand else None
        if isinstance(in_hand, _Entry) and in_hand.job.kind is Kind.COMMISSION and not in_hand.settled:
            entries.append(in_hand)
        return {entry.job.pair: entry.reached for entry in entries}

    def in_progress(self, now_s: float) -> InProgress | None:
        """The work in hand; None if there is none."""
        if self._in_hand is None:
            return None
        work, age_s = self._in_hand.work, now_s - self._in_hand.taken_s
        if isinstance(work, Prefetch):
            return InProgress(PREFETCH, work.pair, PREFETCH, age_s)
        return InProgress(work.job.kind.value, work.job.pair, work.job.subject, age_s)

    # --- inside -----------------------------------------------------------------------------------------------------

    def _next(self, now_s: float) -> _Entry | Prefetch | None:
        checks, live = self._lanes[Lane.CHECK], self._lanes[Lane.LIVE]
        # A check that kills the worker must not keep every new worker from its windows, nor may many checks of other
        # pairs keep a window waiting.
        windows_turn = live and (self._check_was_fatal or now_s - live[0].submitted_s > WINDOW_WAITS_S)
        if checks and not windows_turn:
            return checks.popleft()
        lidars, errands = self._lanes[Lane.LIDARS], self._lanes[Lane.ERRAND]
        backlog, commissionings = self._lanes[Lane.BACKLOG], self._lanes[Lane.COMMISSIONING]
        for waiting in (live, lidars, errands, self._prefetches, backlog, commissionings):
            if waiting:
                return waiting.popleft()
        return None

    def _hand(self) -> _InHand:
        if self._in_hand is None:
            raise ValueError("internal error: no job is assigned to the worker")
        return self._in_hand

    def _is_full(self, lane: Lane, pair: str) -> bool:
        return sum(entry.job.pair == pair for entry in self._lanes[lane]) >= WAITING[lane]

    def _put_back(self, entry: _Entry, reason: Reason, now_s: float) -> None:
        """Puts a job back to the front of its lane, unless newer ones of its pair have filled it."""
        lane = _lane_of(entry.job)
        if not self._is_full(lane, entry.job.pair):
            self._lanes[lane].appendleft(entry)
        elif lane in SUPERSEDING:
            self._end(entry, Fate.SUPERSEDED, SUPERSEDED, now_s)
        else:
            self._end(entry, Fate.FAILED, reason, now_s)

    def _end_late(self, entry: _Entry, now_s: float) -> None:
        text = f"The worker had no answer within {entry.job.patience_s:g} s of the question."
        self._end(entry, Fate.LATE, Reason("deadline_passed", text), now_s)

    def _end(self, entry: _Entry, fate: Fate, end: Answer | Reason, now_s: float) -> None:
        entry.settled = True
        reason = end if isinstance(end, Reason) else None
        answer = None if isinstance(end, Reason) else end
        self._outcomes[fate] += 1
        if reason is not None:
            self._causes[reason.code] += 1
        self._outbox.append((entry.job, JobOutcome(fate, answer, reason, now_s - entry.submitted_s)))


def _lane_of(job: WorkerJob) -> Lane:
    match job.kind:
        case Kind.CHECK:
            return Lane.CHECK
        case Kind.SOLVE:
            return Lane.LIVE if job.live else Lane.BACKLOG
        case Kind.REGISTER:
            return Lane.LIDARS
        case Kind.OVERLAY | Kind.PICTURE:
            return Lane.ERRAND
        case Kind.COMMISSION:
            return Lane.COMMISSIONING
