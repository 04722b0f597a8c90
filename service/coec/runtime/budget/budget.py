"""The budget of a service as its threads use it: streams ask, the worker's supervisor pays, status reports.

It is one lock around one state machine, held for microseconds. A thread of its own would answer a stream some time
later, after further pairs have come. Then it would depend on the machine which pairs make a check, even where nobody
has to wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from coec.config import BudgetConfig, MonitorConfig, WindowConfig
from coec.runtime.budget.spending import CpuUsage
from coec.runtime.budget.turns import CheckScheduler, Share
from coec.runtime.worker import jobs
from coec.runtime.worker.costs import Cost


@dataclass(frozen=True, slots=True)
class BudgetReport:
    """How the budget is spent.

    Attributes:
        cores: the budget, in cores.
        spent: what the worker has spent on everything, in cores, over the last `spending.OVER_S`.
        wanted: what all checks and windows would need, in cores.
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
    """The budget of all pairs of a daemon; for any thread."""

    def __init__(self, config: BudgetConfig, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a steady clock, s."""
        self._clock = clock
        self._lock = threading.Lock()
        self._scheduler = CheckScheduler(config.cores)
        self._usage = CpuUsage(clock())
        self._checked_s: dict[str, float] = {}

    def reconfigure(self, config: BudgetConfig) -> None:
        """Spends by these settings from now on."""
        with self._lock:
            self._scheduler.reconfigure(config.cores)

    def join(self, pair: str, monitor: MonitorConfig, window: WindowConfig) -> float:
        """A pair joins. Returns how long its first slice is to be, s, so that windows of different pairs end at
        different times. It is no shorter than an urgent slice, which suffices for a window."""
        with self._lock:
            phase = self._scheduler.join(pair, monitor.period_s, window.slice_s)
        return window.slice_s - phase * max(window.slice_s - monitor.urgent_slice_s, 0.0)

    def join_checks(self, name: str, period_s: float) -> None:
        """Something joins that wants a look in each period but no windows."""
        with self._lock:
            self._scheduler.join_checks(name, period_s)

    def try_acquire(self, pair: str, stamp_ns: int, *, suspected: bool) -> bool:
        """Whether a check of a pair may begin now that its stream has come to this stamp. If so, call `ended` after
        it."""
        with self._lock:
            return self._scheduler.try_acquire(pair, stamp_ns, suspected=suspected)

    def window_turn_s(self, pair: str, stamp_ns: int) -> float:
        """By how much the end of a window that the rig wants of a pair may be delayed, s, now that the pair's stream
        has come to this stamp. The windows before it are paid by then. It then counts as being on its way."""
        with self._lock:
            return self._scheduler.window_turn_s(pair, stamp_ns)

    def release(self, pair: str) -> None:
        """A check that had begun has ended, with or without a result."""
        with self._lock:
            self._scheduler.release(pair)

    def pay(self, cost: Cost) -> None:
        """Books the cost of the worker's work, for a pair that has joined or for none. Windows of earlier runs,
        pictures and commissionings are not for the stream: they appear in the report, but no check waits until they
        are earned."""
        now_s = self._clock()
        with self._lock:
            self._usage.add(cost.kind, cost.pair, cost.cpu_s, now_s)
            match cost.kind:
                case jobs.Kind.CHECK | jobs.Kind.REGISTER:
                    self._checked_s[cost.pair] = now_s
                    self._scheduler.record_check(cost.pair, cost.cpu_s)
                case jobs.Kind.SOLVE:
                    self._scheduler.record_solve(cost.pair, cost.cpu_s)
                case jobs.PREFETCH:
                    self._scheduler.record_preparation(cost.pair, cost.cpu_s)

    @property
    def stretch(self) -> float:
        """Factor by which slices are to be longer than configured, at least 1."""
        with self._lock:
            return self._scheduler.stretch

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
