"""Whose turn it is: a check may begin when the store holds enough for it and for all waiting checks with a stronger
claim.

A suspected pair comes first and may borrow. Then comes the pair that has not been looked at for longest, counted in its
own periods. If the budget suffices for all, nobody waits, and every check is made at the pair of frames at which it was
asked for. If it does not, only some of these checks are made, and all periods are stretched by the same factor.

It is a state machine without threads or clocks; only sensor time passes in it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from coec.runtime.budget.drive_clock import DriveClock
from coec.runtime.budget.prices import CostModel, lower_median_s
from coec.runtime.budget.store import CHECKS_SHARE, Debt, TokenBucket

SEEN_PERIODS = 6
"""A pair that has asked for nothing for so many of its periods takes no part, because its streams or the vehicle have
stopped. The pairs of one check may span as many periods."""

STRETCH_STEPS = 20
"""Lengths are stretched in steps of one twentieth, so that small changes of a price change nothing."""


@dataclass(frozen=True, slots=True)
class Share:
    """What one pair takes of the budget.

    Attributes:
        look_s: processor time of a check, s; None before the first.
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
    """A pair that shares the budget. `asked_s`: when it last asked; `waits`: whether it was refused then. `begun_s`:
    when its last check began. `has_windows`: False if it wants looks only. `in_hand`: number of checks that have begun
    and not ended. `prepared_s`: cost of the depth for the open window so far."""

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
        self._bucket = TokenBucket(cores)
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
        if self._bucket.level_s - in_hand_s - ahead_s < (-self._bucket.depth_s if suspected else 0.0):
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
        return self._bucket.level_s

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
