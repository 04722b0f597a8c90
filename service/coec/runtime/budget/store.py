"""Processor time in store, and what is owed for windows: a token bucket, in seconds.

As time passes, the store is filled by the budget less the instalments for windows. Windows are paid in instalments
because a solve takes seconds: if it were paid at once, no pair would be looked at until that time is earned. Looks are
paid when they are done. Those who may borrow can take the store down to a debt of the same depth, which is earned again
before anybody else's turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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


class TokenBucket:
    """The store of the whole service. It begins full."""

    def __init__(self, cores: float) -> None:
        """`cores`: processor time that is earned per second."""
        self._cores = cores
        self._now_s = 0.0
        self.level_s = self.depth_s

    @property
    def depth_s(self) -> float:
        """Largest level of the store, and largest debt, s."""
        return BUCKET_DEPTH_S * self._cores

    def reconfigure(self, cores: float) -> None:
        """Sets another budget. What is in store stays, up to the new depth."""
        self._cores = cores
        self.level_s = min(self.level_s, self.depth_s)

    def earn(self, now_s: float, debts: list[Debt]) -> None:
        """Time has come to `now_s`: pays the instalments due from what was earned since the last call, and stores the
        rest."""
        passed_s, self._now_s = max(now_s - self._now_s, 0.0), max(now_s, self._now_s)
        earned_s = self._cores * passed_s
        due_s = [max(debt.owed_s + debt.next_s, 0.0) * -math.expm1(-passed_s / debt.over_s) for debt in debts]
        paid_s = min(sum(due_s), (1.0 - CHECKS_SHARE) * earned_s)
        for debt, part_s in zip(debts, due_s, strict=True):
            debt.owed_s -= part_s * paid_s / sum(due_s) if paid_s else 0.0
        self.level_s = min(self.level_s + earned_s - paid_s, self.depth_s)

    def pay(self, cpu_s: float, usual_s: float) -> None:
        """Pays for a look. An exceptionally dear one leaves a debt of at most twice the depth, or the usual price if
        that is more."""
        self.level_s = max(self.level_s - cpu_s, min(self.level_s, -max(2.0 * self.depth_s, usual_s)))
