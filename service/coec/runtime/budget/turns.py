"""Whose turn it is: a check is made when there is enough in store for it and for all with a stronger claim.

A suspicion comes first, and may borrow; then whoever has not been looked at for longest, in periods of its own. Where
the budget suffices for everybody, nobody waits, and every check is made with the pair at which it was asked for. Where
it does not, the checks that are made are some of those, and all periods are stretched alike.

A state machine: sensor time alone passes in it, and it knows no thread and no clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from coec.runtime.budget.drive_clock import DriveClock
from coec.runtime.budget.prices import Price, middle_s
from coec.runtime.budget.store import LOOKS_SHARE, Debt, Store

SEEN_PERIODS = 6
"""A pair that has asked for nothing for so many of its periods takes no part: its streams have stopped, or the vehicle
has. As many as the pairs of one check may span."""

STEPS = 20
"""In which lengths are stretched, a twentieth each: a price that moves by less moves nothing."""


@dataclass(frozen=True, slots=True)
class Share:
    """What one pair takes of the budget.

    Attributes:
        look_s: what a check costs, processor time; None before the first.
        window_s: what a window costs, with the depth of its images; None before the first.
        suspected: there is a suspicion; its checks come first.
        waiting: a check of it waits for its turn.
        active: its streams ask for checks.
    """

    look_s: float | None
    window_s: float | None
    suspected: bool
    waiting: bool
    active: bool


@dataclass(slots=True)
class _Pair:
    """`asked_s`: when it asked last; `waits`: in vain. `begun_s`: when its last check began. `has_windows`: or looks
    alone. `in_hand`: its checks that have begun and not ended; `prepared_s`: what depth for the open window cost."""

    period_s: float
    debt: Debt
    begun_s: float
    has_windows: bool = True
    asked_s: float = -math.inf
    waits: bool = False
    suspected: bool = False
    in_hand: int = 0
    look: Price = field(default_factory=Price)
    window: Price = field(default_factory=Price)
    prepared_s: float = 0.0


class Turns:
    """Of all pairs of a service."""

    def __init__(self, cores: float) -> None:
        self._cores = cores
        self._clock = DriveClock()
        self._store = Store(cores)
        self._pairs: dict[str, _Pair] = {}
        self._windows_until_s = 0.0

    def use(self, cores: float) -> None:
        """Another budget from now on."""
        self._cores = cores
        self._store.use(cores)

    def join(self, name: str, period_s: float, slice_s: float) -> float:
        """A pair joins that wants a check in each period and a window in each slice. Where in its slice, as a part of
        it from 0 to 1, its first window begins: those of different pairs end at different times, as the worker does one
        after the other and each pair waits for its own."""
        phase = _phase(len(self._pairs))
        self._pairs[name] = _Pair(period_s, Debt(slice_s), self._clock.now_s)
        return phase

    def join_looks(self, name: str, period_s: float) -> None:
        """Something joins that wants a look in each period, and no windows."""
        self._pairs[name] = _Pair(period_s, Debt(period_s), self._clock.now_s, has_windows=False)

    def affords(self, name: str, stamp_ns: int, *, suspected: bool) -> bool:
        """Whether a check of a pair may begin, now that its stream has come to a stamp. It is then taken to begin."""
        pair = self._pairs[name]
        now_s = self._clock.observe(name, stamp_ns, SEEN_PERIODS * pair.period_s)
        self._earn(now_s)
        pair.asked_s, pair.waits, pair.suspected = now_s, True, suspected
        claim = self._claim(name, now_s)
        others = [each for each in self._pairs if each != name and self._waits(each)]
        ahead_s = sum(self._look_s(self._pairs[each]) for each in others if self._claim(each, now_s) > claim)
        in_hand_s = sum(each.in_hand * self._look_s(each) for each in self._pairs.values() if each.in_hand)
        if self._store.level_s - in_hand_s - ahead_s < (-self._store.depth_s if suspected else 0.0):
            return False
        pair.begun_s, pair.waits = now_s, False
        pair.in_hand += 1
        return True

    def window_turn_s(self, name: str, stamp_ns: int) -> float:
        """How much later than at once a window of a pair that is wanted soon may end, now that its stream has come to a
        stamp, s. The windows of all pairs of a sensor follow each other as fast as the budget earns them beside the
        looks; all at once they would be ready together, and keep the worker from every look for as long as they take.
        In whole seconds: a price that moves by a little moves no slice."""
        now_s = self._clock.observe(name, stamp_ns, SEEN_PERIODS * self._pairs[name].period_s)
        begin_s = max(self._windows_until_s, now_s)
        earned_in_s = self._window_s(self._pairs[name]) / ((1.0 - LOOKS_SHARE) * self._cores)
        self._windows_until_s = begin_s + math.ceil(earned_in_s)
        return begin_s - now_s

    def ended(self, name: str) -> None:
        """A check that had begun has ended, whether it was done or not."""
        self._pairs[name].in_hand -= 1

    def looked(self, name: str, cpu_s: float) -> None:
        """A check has cost so much."""
        pair = self._pairs[name]
        pair.look.add(cpu_s)
        self._store.pay(cpu_s, pair.look.cpu_s)

    def prepared(self, name: str, cpu_s: float) -> None:
        """Depth for the open window has cost so much."""
        pair = self._pairs[name]
        pair.prepared_s += cpu_s
        pair.debt.owed_s += cpu_s

    def solved(self, name: str, cpu_s: float) -> None:
        """A window has cost so much, beside what was prepared."""
        pair = self._pairs[name]
        pair.window.add(pair.prepared_s + cpu_s)
        pair.prepared_s = 0.0
        pair.debt.owed_s += cpu_s

    @property
    def cores(self) -> float:
        """The budget."""
        return self._cores

    @property
    def wanted(self) -> float:
        """Of a core, for every check and every window of the pairs that ask for them."""
        return sum(
            self._look_s(pair) / pair.period_s + self._window_s(pair) / pair.debt.over_s
            for pair in self._pairs.values()
            if self._active(pair)
        )

    @property
    def stretch(self) -> float:
        """By how much all periods and slices are longer than configured, at least 1."""
        return max(math.ceil(STEPS * self.wanted / self._cores) / STEPS, 1.0)

    @property
    def in_store_s(self) -> float:
        """Processor time in store; negative: borrowed."""
        return self._store.level_s

    def shares(self) -> Mapping[str, Share]:
        """What each pair takes."""
        return {
            name: Share(
                pair.look.cpu_s if pair.look.known else None,
                pair.window.cpu_s if pair.window.known else None,
                pair.suspected,
                self._waits(name),
                self._active(pair),
            )
            for name, pair in self._pairs.items()
        }

    def _earn(self, now_s: float) -> None:
        for pair in self._pairs.values():
            pair.debt.next_s = self._window_s(pair) if self._active(pair) else 0.0
        self._store.earn(now_s, [pair.debt for pair in self._pairs.values()])

    def _look_s(self, pair: _Pair) -> float:
        """Price of a check, processor time."""
        if pair.look.known:
            return pair.look.cpu_s
        alike = [each.look for each in self._pairs.values() if each.has_windows is pair.has_windows]
        return _expected_s(alike)

    def _window_s(self, pair: _Pair) -> float:
        """Price of a window, processor time."""
        if pair.window.known or not pair.has_windows:
            return pair.window.cpu_s
        return _expected_s([each.window for each in self._pairs.values()])

    def _claim(self, name: str, now_s: float) -> tuple[bool, float, str]:
        """The name decides between equals, so that it is the same one every time."""
        pair = self._pairs[name]
        return pair.suspected, (now_s - pair.begun_s) / pair.period_s, name

    def _waits(self, name: str) -> bool:
        """Whether a check of a pair waits for its turn. One whose stream has stopped does so for a period."""
        pair = self._pairs[name]
        return pair.waits and self._clock.now_s - pair.asked_s <= pair.period_s

    def _active(self, pair: _Pair) -> bool:
        return self._clock.now_s - pair.asked_s <= SEEN_PERIODS * pair.period_s


def _expected_s(others: Sequence[Price]) -> float:
    """What is expected of a pair that has no price yet, s: the middle one of those of the others. With many pairs the
    first windows are most of the work of the first minutes."""
    return middle_s([each.cpu_s for each in others if each.known])


def _phase(index: int) -> float:
    """0, 1/2, 1/4, 3/4, 1/8, ...: the digits of the index behind the point, last first (van der Corput). However many
    there are, they lie far apart."""
    phase, weight = 0.0, 0.5
    while index:
        phase += weight * (index & 1)
        index, weight = index >> 1, 0.5 * weight
    return phase
