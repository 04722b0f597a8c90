"""Processor time that is in store, and what is owed for windows: a token bucket, s.

It is filled as time passes, by the budget less the instalments of what windows cost: a solve takes seconds, and if
it were paid at once no pair would be looked at for as long as that is earned. Looks are paid when they are done. What
is in store goes down to a debt of the same depth for whoever may borrow, and is earned again before anybody else's
turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

DEPTH_S = 10.0
"""Depth of the store, in seconds of the budget: two rounds of checks every five seconds. As much may be borrowed, so
that others wait for no longer than that, on top of their turn."""

LOOKS_SHARE = 0.25
"""Of the budget that looks have in any case: however much windows cost, somebody has to see that they are right."""


@dataclass(slots=True)
class Debt:
    """What is owed for the windows of a pair, s, and over how long it is paid, s.

    Attributes:
        owed_s: negative: saved for the next one.
        next_s: what the next one is expected to cost. It is saved for, or many windows at the beginning, of which
            nothing is paid yet, would come on top of what looks spend.
    """

    over_s: float
    owed_s: float = 0.0
    next_s: float = 0.0


class Store:
    """The store of the whole service. It begins full."""

    def __init__(self, cores: float) -> None:
        """`cores`: seconds of processor time earned in a second."""
        self._cores = cores
        self._now_s = 0.0
        self.level_s = self.depth_s

    @property
    def depth_s(self) -> float:
        """Most that can lie in store, and be borrowed."""
        return DEPTH_S * self._cores

    def use(self, cores: float) -> None:
        """Another budget from now on; what is in store stays, as far as there is room."""
        self._cores = cores
        self.level_s = min(self.level_s, self.depth_s)

    def earn(self, now_s: float, debts: list[Debt]) -> None:
        """It is `now_s`: what has been earned since the last time pays the instalments that are due, and is stored."""
        passed_s, self._now_s = max(now_s - self._now_s, 0.0), max(now_s, self._now_s)
        earned_s = self._cores * passed_s
        due_s = [max(debt.owed_s + debt.next_s, 0.0) * -math.expm1(-passed_s / debt.over_s) for debt in debts]
        paid_s = min(sum(due_s), (1.0 - LOOKS_SHARE) * earned_s)
        for debt, part_s in zip(debts, due_s, strict=True):
            debt.owed_s -= part_s * paid_s / sum(due_s) if paid_s else 0.0
        self.level_s = min(self.level_s + earned_s - paid_s, self.depth_s)

    def pay(self, cpu_s: float, usual_s: float) -> None:
        """A look has cost so much. A freak leaves no larger debt than twice the depth, or a look of the usual price."""
        self.level_s = max(self.level_s - cpu_s, min(self.level_s, -max(2.0 * self.depth_s, usual_s)))
