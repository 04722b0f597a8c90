"""What the threads of a service see of its budget, and what is told of it."""

from __future__ import annotations

import pytest

from coec.config import BudgetConfig, MonitorConfig, WindowConfig
from coec.service.api import metrics
from coec.service.api.metrics import MetricsInput
from coec.service.api.reply_builders import budget_status_of
from coec.service.cpu_budget import COST_SAMPLES, USAGE_BIN_S, USAGE_OVER_S, Budget, CostModel, CpuUsage
from coec.service.worker import worker_jobs
from coec.service.worker.worker_jobs import START, Cost
from support.messages import status_reply

S = 1_000_000_000


class Clock:
    """A steady clock that goes when it is told to."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def budget(clock: Clock) -> Budget:
    made = Budget(BudgetConfig(cores=0.5), clock)
    made.join("front", MonitorConfig(), WindowConfig())
    made.join("rear", MonitorConfig(), WindowConfig())
    return made


def test_what_everything_would_take_is_reported_with_what_it_stretches(budget: Budget, clock: Clock) -> None:
    clock.now_s = 100.0
    for pair in ("front", "rear"):
        assert budget.try_acquire(pair, S, suspected=False)
        budget.pay(Cost(worker_jobs.Kind.CHECK, pair, 2.0))
        budget.release(pair)
    for _ in range(25):
        budget.pay(Cost(worker_jobs.PREFETCH, "front", 0.1))
    budget.pay(Cost(worker_jobs.Kind.SOLVE, "front", 6.5))
    budget.pay(Cost(START, "", 3.5))
    clock.now_s = 103.0
    reported = budget_status_of(budget.report())
    assert reported.cores == 0.5
    assert reported.wanted == pytest.approx(2 * (2.0 / 5.0 + 9.0 / 180.0)), (
        "what one window costs is expected of the other"
    )
    assert reported.stretched_by == pytest.approx(reported.wanted / 0.5, abs=0.05)
    assert reported.spent == pytest.approx(16.5 / 103.0)
    assert reported.in_store_s == pytest.approx(5.0 - 4.0)
    assert reported.spent_s == pytest.approx({"check": 4.0, "prefetch": 2.5, "solve": 6.5, "start": 3.5})
    assert reported.pairs["front"].window_s == pytest.approx(9.0)
    assert reported.pairs["rear"].window_s is None
    assert reported.pairs["rear"].unseen_s == pytest.approx(3.0)
    status = status_reply(budget=reported)
    lines = metrics.render(MetricsInput(status, {})).decode().splitlines()
    assert 'coec_worker_processor_seconds_total{kind="solve"} 6.5' in lines
    assert "coec_budget_cores 0.5" in lines
    assert "coec_budget_store_seconds 1" in lines
    assert 'coec_unseen_seconds{pair="rear"} 3' in lines


def test_pictures_and_windows_of_earlier_runs_keep_nobody_waiting(budget: Budget) -> None:
    for kind in ("overlay", "picture", "commission", "backlog", "idle"):
        budget.pay(Cost(kind, "front", 1000.0))
    assert budget.try_acquire("front", S, suspected=False)
    report = budget.report()
    assert report.demand == 0.0
    assert sum(report.totals_s.values()) == 5000.0, "but they are told"


def test_what_has_started_counts_until_it_has_finished(budget: Budget) -> None:
    for pair in ("front", "rear"):
        assert budget.try_acquire(pair, S, suspected=False)
        budget.pay(Cost(worker_jobs.Kind.CHECK, pair, 2.0))
        budget.release(pair)
    assert budget.try_acquire("front", S, suspected=False), "1 s lies in store"
    assert not budget.try_acquire("rear", S, suspected=False), "2 s of which are spoken for"
    budget.release("front")
    assert budget.try_acquire("rear", S, suspected=False)


def test_first_slices_end_at_different_times_and_none_is_too_short_for_a_window(budget: Budget) -> None:
    joined = [budget.join(name, MonitorConfig(), WindowConfig()) for name in ("left", "right")]
    assert joined == [pytest.approx(180.0 - 0.25 * 150.0), pytest.approx(180.0 - 0.75 * 150.0)]
    short = WindowConfig(slice_s=20.0)
    assert budget.join("short", MonitorConfig(), short) == 20.0


def test_one_measurement_in_a_hurry_moves_no_price() -> None:
    price = CostModel()
    assert (price.cpu_s, price.known) == (0.0, False)
    price.add(30.0)
    assert price.cpu_s == 30.0
    price.add(0.2)
    assert price.cpu_s == 0.2, "a first look in a process that is new costs more than others"
    for _ in range(COST_SAMPLES):
        price.add(0.1)
    price.add(1e9)
    price.add(-1.0)
    assert price.cpu_s == 0.1


def test_usage_is_reported_over_the_last_minutes() -> None:
    usage = CpuUsage(1000.0)
    usage.add("check", "front", 1.0, 1001.0)
    assert usage.cores(1001.0) == pytest.approx(1.0 / USAGE_BIN_S), "not over less than it is counted in"
    assert usage.cores(1010.0) == pytest.approx(0.1)
    for second in range(1010, 2000, 10):
        usage.add("check", "front", 4.0, float(second))
    assert usage.cores(2000.0) == pytest.approx(0.4, rel=0.1)
    assert usage.cores(2000.0 + USAGE_OVER_S + USAGE_BIN_S) == 0.0
    assert usage.totals_s == {("check", "front"): pytest.approx(1.0 + 99 * 4.0)}
