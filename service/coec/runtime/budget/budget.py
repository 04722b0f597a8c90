"""The budget of a service as its threads see it: streams ask, the worker's supervisor pays, status tells.

One lock around one state machine, held for microseconds. A thread of its own would answer a stream some time later, at
whichever pair has come by then: which pairs make a check would be a matter of the machine even where nobody has to
wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from coec.config import BudgetConfig, MonitorConfig, WindowConfig
from coec.runtime.budget.spending import Spending
from coec.runtime.budget.turns import Share, Turns
from coec.runtime.worker import jobs
from coec.runtime.worker.costs import Cost


@dataclass(frozen=True, slots=True)
class BudgetReport:
    """How the budget is spent.

    Attributes:
        cores: what may be spent, of a core.
        spent: what the worker has taken, for whatever it did, of a core; see `spending.OVER_S`.
        wanted: what every check and every window would take.
        stretched_by: by how much periods and slices are longer than configured.
        in_store_s: processor time in store; negative: borrowed.
        pairs: what each takes.
        unseen_s: since the worker last looked at each pair, by the steady clock; without those it never did.
        totals_s: processor time since the start, by kind and pair, s.
    """

    cores: float
    spent: float
    wanted: float
    stretched_by: float
    in_store_s: float
    pairs: Mapping[str, Share]
    unseen_s: Mapping[str, float]
    totals_s: Mapping[tuple[str, str], float]


class Budget:
    """Of all pairs of a daemon; for any thread."""

    def __init__(self, config: BudgetConfig, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a steady one, s."""
        self._clock = clock
        self._lock = threading.Lock()
        self._turns = Turns(config.cores)
        self._spending = Spending(clock())
        self._looked_s: dict[str, float] = {}

    def use(self, config: BudgetConfig) -> None:
        """Spend by this from now on."""
        with self._lock:
            self._turns.use(config.cores)

    def join(self, pair: str, monitor: MonitorConfig, window: WindowConfig) -> float:
        """A pair joins; how long its first slice is to be, s: windows of different pairs end at different times. No
        shorter than an urgent one, which is enough for a window."""
        with self._lock:
            phase = self._turns.join(pair, monitor.period_s, window.slice_s)
        return window.slice_s - phase * max(window.slice_s - monitor.urgent_slice_s, 0.0)

    def join_looks(self, name: str, period_s: float) -> None:
        """Something joins that wants a look in each period, and no windows."""
        with self._lock:
            self._turns.join_looks(name, period_s)

    def affords(self, pair: str, stamp_ns: int, *, suspected: bool) -> bool:
        """Whether a check of a pair, whose stream has come to this stamp, may begin; `ended` has to follow then."""
        with self._lock:
            return self._turns.affords(pair, stamp_ns, suspected=suspected)

    def window_turn_s(self, pair: str, stamp_ns: int) -> float:
        """How much later than at once a window of a pair that the rig wants may end, now that its stream has come to
        this stamp, s: those before it are paid then. It is taken to be on its way."""
        with self._lock:
            return self._turns.window_turn_s(pair, stamp_ns)

    def ended(self, pair: str) -> None:
        """A check that had begun has ended, however it did."""
        with self._lock:
            self._turns.ended(pair)

    def pay(self, cost: Cost) -> None:
        """The worker has done something, for a pair that has joined or for none. Windows of earlier runs, pictures and
        commissionings are not for the stream: they are told, and nobody waits for them to be earned."""
        now_s = self._clock()
        with self._lock:
            self._spending.add(cost.kind, cost.pair, cost.cpu_s, now_s)
            match cost.kind:
                case jobs.Kind.CHECK | jobs.Kind.REGISTER:
                    self._looked_s[cost.pair] = now_s
                    self._turns.looked(cost.pair, cost.cpu_s)
                case jobs.Kind.SOLVE:
                    self._turns.solved(cost.pair, cost.cpu_s)
                case jobs.PREFETCH:
                    self._turns.prepared(cost.pair, cost.cpu_s)

    @property
    def stretch(self) -> float:
        """By how much slices are to be longer than configured, at least 1."""
        with self._lock:
            return self._turns.stretch

    def report(self) -> BudgetReport:
        """How the budget is spent."""
        now_s = self._clock()
        with self._lock:
            turns = self._turns
            return BudgetReport(
                turns.cores,
                self._spending.cores(now_s),
                turns.wanted,
                turns.stretch,
                turns.in_store_s,
                turns.shares(),
                {pair: now_s - looked_s for pair, looked_s in self._looked_s.items()},
                self._spending.totals_s,
            )
