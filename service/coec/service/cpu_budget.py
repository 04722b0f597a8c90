"""The processor budget of a service: which pair's check may begin, what checks and windows cost, and what was used.
Streams acquire checks, the worker's supervisor books their cost, status reports.

A check may begin when the token bucket holds enough for it and for all waiting checks with a stronger claim. A
suspected pair comes first and may borrow. Then comes the pair whose last check is longest ago, counted in its own
periods. If the budget suffices for all, nobody waits, and every check is made at the pair of frames at which it was
requested. If it does not, only some of these checks are made, and all periods are stretched by the same factor.

The bucket holds seconds of processor time. As time passes, it is filled by the budget less the instalments for windows.
Windows are paid in instalments because a solve takes seconds: if it were paid at once, no pair would be checked until
that time is earned. Checks are paid when they are done. Those who may borrow can take the bucket down to a debt as
large as its capacity, which is earned again before any other check begins.

The scheduler is a state machine without threads or clocks; only sensor time passes in it. `Budget` is one lock around
it, held for microseconds: a thread of its own would answer a stream some time later, after further pairs have come, and
which pairs make a check would then depend on the machine.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from coec.config import BudgetConfig, MonitorConfig, WindowConfig
from coec.service.timing import DriveClock, TokenBucket
from coec.service.worker import worker_jobs

COST_SAMPLES = 9
"""How many measurements are kept; their median is the price. Outliers (other load on the machine, a new process, a hard
scene) do not move it while they are fewer than half."""

LARGEST_COST_S = 600.0
"""Most processor time that one measurement counts, s: five times the longest that a job may take by default."""


class CostModel:
    """Processor time of one kind of work, s.

    Attributes:
        cpu_s: median of the last measurements, the lower one of two; 0 before the first.
    """

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=COST_SAMPLES)
        self.cpu_s = 0.0

    def add(self, cpu_s: float) -> None:
        """Adds a measurement."""
        self._seen.append(min(max(cpu_s, 0.0), LARGEST_COST_S))
        self.cpu_s = lower_median_s(list(self._seen))

    @property
    def known(self) -> bool:
        """Whether there is any measurement."""
        return bool(self._seen)


def lower_median_s(measured_s: list[float]) -> float:
    """The median, the lower one of two; 0 if there are no measurements."""
    return sorted(measured_s)[(len(measured_s) - 1) // 2] if measured_s else 0.0


BUCKET_DEPTH_S = 10.0
"""Depth of the store, in seconds of the budget: two rounds of checks every five seconds. As much may be borrowed, so
others wait at most this time longer for their turn."""

CHECKS_SHARE = 0.25
"""Share of the budget that is reserved for looks: however much windows cost, what is served has to be checked."""


@dataclass(slots=True)
class Debt:
    """What is owed for the windows of a pair, s, and over how long it is paid, s.

    Attributes:
        owed_s: processor time owed; negative: saved for the next window.
        next_s: expected cost of the next window, for which time is saved in advance. Otherwise the many windows at the
            beginning, for which nothing is paid yet, would come on top of what looks spend.
    """

    over_s: float
    owed_s: float = 0.0
    next_s: float = 0.0


class CpuBucket(TokenBucket):
    """Processor time of the whole service, s."""

    def __init__(self, cores: float) -> None:
        """`cores`: processor time that is earned per second."""
        super().__init__(BUCKET_DEPTH_S * cores)
        self._cores = cores

    def reconfigure(self, cores: float) -> None:
        """Sets another budget. What is in store stays, up to the new depth."""
        self._cores, self.depth = cores, BUCKET_DEPTH_S * cores
        self.add(0.0)

    def earn(self, now_s: float, debts: list[Debt]) -> None:
        """Time has come to `now_s`: pays the instalments due from what was earned since the last call, and stores the
        rest."""
        passed_s = self.advance(now_s)
        earned_s = self._cores * passed_s
        due_s = [max(debt.owed_s + debt.next_s, 0.0) * -math.expm1(-passed_s / debt.over_s) for debt in debts]
        paid_s = min(sum(due_s), (1.0 - CHECKS_SHARE) * earned_s)
        for debt, part_s in zip(debts, due_s, strict=True):
            debt.owed_s -= part_s * paid_s / sum(due_s) if paid_s else 0.0
        self.add(earned_s - paid_s)

    def pay(self, cpu_s: float, usual_s: float) -> None:
        """Pays for a look. An exceptionally dear one leaves a debt of at most twice the depth, or the usual price if
        that is more."""
        self.level = max(self.level - cpu_s, min(self.level, -max(2.0 * self.depth, usual_s)))


SEEN_PERIODS = 6
"""A pair that has asked for nothing for so many of its periods takes no part, because its streams or the vehicle have
stopped. The pairs of one check may span as many periods."""

STRETCH_STEPS = 20
"""Lengths are stretched in steps of one twentieth, so that small changes of a price change nothing."""


@dataclass(frozen=True, slots=True)
class Share:
    """What one pair takes of the budget.

    Attributes:
        check_s: processor time of a check, s; None before the first.
        window_s: processor time of a window with the depth of its images, s; None before the first.
        suspected: the pair is suspected, so its checks come first.
        waiting: a check of the pair waits for its turn.
        active: the pair's streams ask for checks.
    """

    check_s: float | None
    window_s: float | None
    suspected: bool
    waiting: bool
    active: bool


@dataclass(slots=True)
class _PairBudget:
    """A pair that shares the budget. `requested_s`: when it last asked; `waits`: whether it was refused then.
    `started_s`: when its last check began. `has_windows`: False if it wants checks only. `in_hand`: number of
    checks that have begun and not ended. `prepared_s`: cost of the depth for the open window so far."""

    period_s: float
    debt: Debt
    started_s: float
    has_windows: bool = True
    requested_s: float = -math.inf
    waits: bool = False
    suspected: bool = False
    in_hand: int = 0
    check_cost: CostModel = field(default_factory=CostModel)
    window_cost: CostModel = field(default_factory=CostModel)
    prepared_s: float = 0.0


class CheckScheduler:
    """The turns of all pairs of a service."""

    def __init__(self, cores: float) -> None:
        self._cores = cores
        self._clock = DriveClock()
        self._bucket = CpuBucket(cores)
        self._pairs: dict[str, _PairBudget] = {}
        self._windows_until_s = 0.0

    def reconfigure(self, cores: float) -> None:
        """Sets another budget."""
        self._cores = cores
        self._bucket.reconfigure(cores)

    def join(self, name: str, period_s: float, slice_s: float) -> float:
        """A pair joins that wants a check in each period and a window in each slice. Returns at which part of its
        slice, from 0 to 1, its first window begins. Windows of different pairs are to end at different times, because
        the worker solves one after the other and each pair waits for its own."""
        phase = _phase(len(self._pairs))
        self._pairs[name] = _PairBudget(period_s, Debt(slice_s), self._clock.now_s)
        return phase

    def join_checks(self, name: str, period_s: float) -> None:
        """Something joins that wants a look in each period but no windows."""
        self._pairs[name] = _PairBudget(period_s, Debt(period_s), self._clock.now_s, has_windows=False)

    def try_acquire(self, name: str, stamp_ns: int, *, suspected: bool) -> bool:
        """Whether a check of a pair may begin, now that its stream has come to a stamp. If so, it counts as begun."""
        pair = self._pairs[name]
        now_s = self._clock.observe(name, stamp_ns, SEEN_PERIODS * pair.period_s)
        self._earn(now_s)
        pair.requested_s, pair.waits, pair.suspected = now_s, True, suspected
        claim = self._claim(name, now_s)
        others = [each for each in self._pairs if each != name and self._waits(each)]
        ahead_s = sum(self._check_s(self._pairs[each]) for each in others if self._claim(each, now_s) > claim)
        in_hand_s = sum(each.in_hand * self._check_s(each) for each in self._pairs.values() if each.in_hand)
        if self._bucket.level - in_hand_s - ahead_s < (-self._bucket.depth if suspected else 0.0):
            return False
        pair.started_s, pair.waits = now_s, False
        pair.in_hand += 1
        return True

    def window_turn_s(self, name: str, stamp_ns: int) -> float:
        """By how much the end of an urgent window of a pair may be delayed, s, now that its stream has come to a stamp.
        So the windows of all pairs of a sensor follow each other as fast as the budget earns them beside the looks. If
        all were ready at once, the worker could not look at any pair until it has solved them all. In whole seconds,
        so that small changes of a price move no slice."""
        now_s = self._clock.observe(name, stamp_ns, SEEN_PERIODS * self._pairs[name].period_s)
        begin_s = max(self._windows_until_s, now_s)
        earned_in_s = self._window_s(self._pairs[name]) / ((1.0 - CHECKS_SHARE) * self._cores)
        self._windows_until_s = begin_s + math.ceil(earned_in_s)
        return begin_s - now_s

    def release(self, name: str) -> None:
        """A check that had begun has ended, with or without a result."""
        self._pairs[name].in_hand -= 1

    def record_check(self, name: str, cpu_s: float) -> None:
        """Books the cost of a check."""
        pair = self._pairs[name]
        pair.check_cost.add(cpu_s)
        self._bucket.pay(cpu_s, pair.check_cost.cpu_s)

    def record_preparation(self, name: str, cpu_s: float) -> None:
        """Books the cost of depth for the open window."""
        pair = self._pairs[name]
        pair.prepared_s += cpu_s
        pair.debt.owed_s += cpu_s

    def record_solve(self, name: str, cpu_s: float) -> None:
        """Books the cost of a window, in addition to what was prepared."""
        pair = self._pairs[name]
        pair.window_cost.add(pair.prepared_s + cpu_s)
        pair.prepared_s = 0.0
        pair.debt.owed_s += cpu_s

    @property
    def cores(self) -> float:
        """The budget, in cores."""
        return self._cores

    @property
    def demand(self) -> float:
        """What all checks and windows of the active pairs would need, in cores."""
        return sum(
            self._check_s(pair) / pair.period_s + self._window_s(pair) / pair.debt.over_s
            for pair in self._pairs.values()
            if self._active(pair)
        )

    @property
    def stretch(self) -> float:
        """Factor by which all periods and slices are longer than configured, at least 1."""
        return max(math.ceil(STRETCH_STEPS * self.demand / self._cores) / STRETCH_STEPS, 1.0)

    @property
    def in_store_s(self) -> float:
        """Processor time in store; negative: borrowed."""
        return self._bucket.level

    def shares(self) -> Mapping[str, Share]:
        """What each pair takes."""
        return {
            name: Share(
                pair.check_cost.cpu_s if pair.check_cost.known else None,
                pair.window_cost.cpu_s if pair.window_cost.known else None,
                pair.suspected,
                self._waits(name),
                self._active(pair),
            )
            for name, pair in self._pairs.items()
        }

    def _earn(self, now_s: float) -> None:
        for pair in self._pairs.values():
            pair.debt.next_s = self._window_s(pair) if self._active(pair) else 0.0
        self._bucket.earn(now_s, [pair.debt for pair in self._pairs.values()])

    def _check_s(self, pair: _PairBudget) -> float:
        """Price of a check, processor time."""
        if pair.check_cost.known:
            return pair.check_cost.cpu_s
        alike = [each.check_cost for each in self._pairs.values() if each.has_windows is pair.has_windows]
        return _expected_s(alike)

    def _window_s(self, pair: _PairBudget) -> float:
        """Price of a window, processor time."""
        if pair.window_cost.known or not pair.has_windows:
            return pair.window_cost.cpu_s
        return _expected_s([each.window_cost for each in self._pairs.values()])

    def _claim(self, name: str, now_s: float) -> tuple[bool, float, str]:
        """Sort key of a pair's claim; the greatest comes first. The name decides between equals, so that the order is
        always the same."""
        pair = self._pairs[name]
        return pair.suspected, (now_s - pair.started_s) / pair.period_s, name

    def _waits(self, name: str) -> bool:
        """Whether a check of a pair waits for its turn. After its stream has stopped it waits for one period more."""
        pair = self._pairs[name]
        return pair.waits and self._clock.now_s - pair.requested_s <= pair.period_s

    def _active(self, pair: _PairBudget) -> bool:
        return self._clock.now_s - pair.requested_s <= SEEN_PERIODS * pair.period_s


def _expected_s(others: Sequence[CostModel]) -> float:
    """Expected price of a pair that has none yet, s: the median of the others' prices. It matters because with many
    pairs the first windows are most of the work of the first minutes."""
    return lower_median_s([each.cpu_s for each in others if each.known])


def _phase(index: int) -> float:
    """0, 1/2, 1/4, 3/4, 1/8, ...: the binary digits of the index in reverse order behind the point (van der Corput).
    Any number of such values lie far apart."""
    phase, weight = 0.0, 0.5
    while index:
        phase += weight * (index & 1)
        index, weight = index >> 1, 0.5 * weight
    return phase


USAGE_OVER_S = 180.0
"""Time over which `cores` is averaged, s: a window and the checks beside it, at the default length of a slice."""

USAGE_BIN_S = 5.0
"""Width of the bins in which the time is counted, s."""


class CpuUsage:
    """Processor time spent. Times are of one steady clock, s."""

    def __init__(self, begin_s: float) -> None:
        self._begin_s = begin_s
        self._bins: deque[tuple[int, float]] = deque()
        self._totals: dict[tuple[str, str], float] = {}

    def add(self, kind: str, pair: str, cpu_s: float, now_s: float) -> None:
        """Adds processor time of work of this kind, for a pair or (empty) for none."""
        self._totals[kind, pair] = self._totals.get((kind, pair), 0.0) + cpu_s
        index = int(now_s // USAGE_BIN_S)
        if self._bins and self._bins[-1][0] == index:
            cpu_s += self._bins.pop()[1]
        self._bins.append((index, cpu_s))
        while self._bins[0][0] * USAGE_BIN_S < now_s - USAGE_OVER_S:
            self._bins.popleft()

    def cores(self, now_s: float) -> float:
        """Cores in use on average over the last `USAGE_OVER_S`, or since the beginning."""
        spent_s = sum(cpu_s for index, cpu_s in self._bins if index * USAGE_BIN_S >= now_s - USAGE_OVER_S)
        return spent_s / max(min(now_s - self._begin_s, USAGE_OVER_S), USAGE_BIN_S)

    @property
    def totals_s(self) -> Mapping[tuple[str, str], float]:
        """Processor time since the beginning by kind and pair, s."""
        return dict(self._totals)


@dataclass(frozen=True, slots=True)
class BudgetReport:
    """How the budget is spent.

    Attributes:
        cores: the budget, in cores.
        spent: what the worker has spent on everything, in cores, over the last `USAGE_OVER_S`.
        demand: what all checks and windows would need, in cores.
        stretched_by: factor by which periods and slices are longer than configured.
        in_store_s: processor time in store; negative: borrowed.
        pairs: what each pair takes.
        unseen_s: time since the worker last looked at each pair, by the steady clock; pairs never looked at are left
            out.
        totals_s: processor time since the start, by kind and pair, s.
    """

    cores: float
    spent: float
    demand: float
    stretched_by: float
    in_store_s: float
    pairs: Mapping[str, Share]
    unseen_s: Mapping[str, float]
    totals_s: Mapping[tuple[str, str], float]


class Budget:
    """The budget of all pairs of a daemon; for any thread.

    Attributes:
        stretch: factor by which slices are to be longer than configured, at least 1.
    """

    def __init__(self, config: BudgetConfig, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a steady clock, s."""
        self._clock = clock
        self._lock = threading.Lock()
        self._scheduler = CheckScheduler(config.cores)
        self.stretch = 1.0
        self._usage = CpuUsage(clock())
        self._checked_s: dict[str, float] = {}

    def reconfigure(self, config: BudgetConfig) -> None:
        """Spends by these settings from now on."""
        with self._scheduling() as scheduler:
            scheduler.reconfigure(config.cores)

    def join(self, pair: str, monitor: MonitorConfig, window: WindowConfig) -> float:
        """A pair joins. Returns how long its first slice is to be, s, so that windows of different pairs end at
        different times. It is no shorter than an urgent slice, which suffices for a window."""
        with self._scheduling() as scheduler:
            phase = scheduler.join(pair, monitor.period_s, window.slice_s)
        return window.slice_s - phase * max(window.slice_s - monitor.urgent_slice_s, 0.0)

    def join_checks(self, name: str, period_s: float) -> None:
        """Something joins that wants a look in each period but no windows."""
        with self._scheduling() as scheduler:
            scheduler.join_checks(name, period_s)

    def try_acquire(self, pair: str, stamp_ns: int, *, suspected: bool) -> bool:
        """Whether a check of a pair may begin now that its stream has come to this stamp. If so, call `release`
        after it."""
        with self._scheduling() as scheduler:
            return scheduler.try_acquire(pair, stamp_ns, suspected=suspected)

    def window_turn_s(self, pair: str, stamp_ns: int) -> float:
        """By how much the end of a window that the rig wants of a pair may be delayed, s, now that the pair's stream
        has come to this stamp. The windows before it are paid by then. It then counts as being on its way."""
        with self._scheduling() as scheduler:
            return scheduler.window_turn_s(pair, stamp_ns)

    def release(self, pair: str) -> None:
        """A check that had begun has ended, with or without a result."""
        with self._scheduling() as scheduler:
            scheduler.release(pair)

    def pay(self, cost: worker_jobs.Cost) -> None:
        """Books the cost of the worker's work, for a pair that has joined or for none. Windows of earlier runs,
        pictures and commissionings are not for the stream: they appear in the report, but no check waits until they
        are earned."""
        now_s = self._clock()
        with self._scheduling() as scheduler:
            self._usage.add(cost.kind, cost.pair, cost.cpu_s, now_s)
            match cost.kind:
                case worker_jobs.Kind.CHECK | worker_jobs.Kind.REGISTER:
                    self._checked_s[cost.pair] = now_s
                    scheduler.record_check(cost.pair, cost.cpu_s)
                case worker_jobs.Kind.SOLVE:
                    scheduler.record_solve(cost.pair, cost.cpu_s)
                case worker_jobs.PREFETCH:
                    scheduler.record_preparation(cost.pair, cost.cpu_s)

    def report(self) -> BudgetReport:
        """How the budget is spent."""
        now_s = self._clock()
        with self._lock:
            scheduler = self._scheduler
            return BudgetReport(
                scheduler.cores,
                self._usage.cores(now_s),
                scheduler.demand,
                scheduler.stretch,
                scheduler.in_store_s,
                scheduler.shares(),
                {pair: now_s - checked_s for pair, checked_s in self._checked_s.items()},
                self._usage.totals_s,
            )

    @contextmanager
    def _scheduling(self) -> Iterator[CheckScheduler]:
        """The scheduler, for one thread at a time; what it does may change the stretch."""
        with self._lock:
            yield self._scheduler
            self.stretch = self._scheduler.stretch
