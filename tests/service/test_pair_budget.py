"""A pair whose checks and windows are not all afforded: what it is checked by, what it says, and who comes first."""

from __future__ import annotations

from pathlib import Path

import pytest

from coec.calibration.types import Reason
from coec.service.worker.worker_jobs import Kind
from support.vehicles import BEGIN_S, DRIVE_END_S, STEP_S, PairBench


def driven(folder: Path, cores: float, cost_s: dict[Kind, float], end_s: int = STEP_S) -> PairBench:
    bench = PairBench(folder, cores=cores)
    bench.worker.cost_s.update(cost_s)
    bench.drive(BEGIN_S, end_s)
    return bench


@pytest.mark.fault(
    "a budget that does not suffice", "the checks that are made are a subset of those of a larger budget"
)
def test_a_small_budget_makes_some_of_the_checks_of_a_large_one(tmp_path: Path) -> None:
    small = driven(tmp_path / "small", 0.1, {Kind.CHECK: 1.0}).worker.checked
    large = driven(tmp_path / "large", 10.0, {Kind.CHECK: 1.0}).worker.checked
    assert set(small) < set(large)
    assert len(large) == pytest.approx(20, abs=2)
    assert len(small) == pytest.approx(10, abs=2)


def test_a_budget_that_suffices_decides_like_one_without_end(tmp_path: Path) -> None:
    """What work costs changes nothing as long as it can be paid."""
    costs = {Kind.CHECK: 0.7, Kind.SOLVE: 5.0}
    enough = driven(tmp_path / "enough", 0.5, costs, DRIVE_END_S)
    free = driven(tmp_path / "free", 64.0, {}, DRIVE_END_S)
    assert enough.worker.checked == free.worker.checked
    assert enough.decisions() == free.decisions()
    assert enough.recorder.stamps == free.recorder.stamps
    assert enough.losses == free.losses


@pytest.mark.fault("a budget at which a pair is hardly ever looked at", "health is not green and says why")
def test_a_pair_that_is_not_afforded_is_never_silently_green(tmp_path: Path) -> None:
    bench = driven(tmp_path, 0.01, {Kind.CHECK: 2.0}, BEGIN_S + 75)  # a window that is judged at 40 s is as good
    assert len(bench.worker.checked) == 1
    assert bench.losses["monitor", "check_not_afforded"] >= 10
    bench.check_clocks()
    health = bench.answers.health_reply
    assert health.state == "degraded"
    assert any(reason.code.startswith("overdue_") for reason in health.reasons), "which one is told by what came"


def test_slices_are_longer_where_windows_are_not_all_afforded(tmp_path: Path) -> None:
    bench = PairBench(tmp_path, cores=0.1)
    bench.worker.cost_s[Kind.SOLVE] = 8.0
    bench.drive(STEP_S - 260, STEP_S)
    assert bench.budget.stretch == pytest.approx(2.0)
    spans_s = [(stamps[-1] - stamps[0]) / 1e9 for stamps in bench.recorder.stamps.values()]
    assert max(spans_s[:2]) < 40.0, "what a window costs is known when the first is solved, and the second has begun"
    assert min(spans_s[2:]) > 60.0


def test_a_suspicion_is_reported_to_the_budget_until_it_is_over(tmp_path: Path) -> None:
    bench = driven(tmp_path, 0.5, {Kind.CHECK: 0.1})
    assert not bench.budget.report().pairs["front"].suspected
    reported = set()
    for second in range(STEP_S, DRIVE_END_S):
        bench.drive(second, second + 1)
        reported.add((bench.health, bench.budget.report().pairs["front"].suspected))
    assert ("miscalibrated", True) in reported
    bench.drive(DRIVE_END_S, DRIVE_END_S + 60)
    assert bench.health == "healthy"
    assert not bench.budget.report().pairs["front"].suspected


def test_a_check_that_fails_gives_its_turn_back(tmp_path: Path) -> None:
    """Whether it was done or not: what is in hand is nobody's for ever."""
    bench = driven(tmp_path, 0.5, {})
    bench.worker.fault = Reason("no", "not here")
    bench.worker.cost_s[Kind.CHECK] = 0.5
    bench.drive(STEP_S, STEP_S + 60)
    report = bench.budget.report()
    assert report.pairs["front"].check_s == 0.5
    assert not report.pairs["front"].waiting
    assert report.in_store_s > 0.0
