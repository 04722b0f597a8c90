"""What a pair says of itself when time, the worker or the recorder misbehave: never green without having looked."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from coec.calibration.types import Reason
from support.vehicles import BEGIN_S, NS_PER_S, STEP_S, PairBench, SlowWorker, frame_pair_at


@pytest.fixture
def bench(tmp_path: Path) -> PairBench:
    return PairBench(tmp_path / "state")


def test_a_drive_played_three_times_is_checked_each_time(bench: PairBench) -> None:
    for turn in range(3):
        bench.drive(BEGIN_S, BEGIN_S + 60)
        assert bench.health == "healthy"
        assert bench.answers.status().checks >= 8 * (turn + 1)
        assert not bench.pair.stream.held.pairs
    reported = [entry.text for entry in bench.entries("state") if entry.code == "unknown"]
    assert len(reported) == 2
    assert all("stepped back" in text and "Last known: healthy" in text for text in reported)
    assert bench.losses["monitor", "time_stepped_back"] == 2
    assert ("monitor", "not_awaited") not in bench.losses


@pytest.mark.fault("stamps an hour ahead, then back", "the old time goes on at once")
def test_after_stamps_an_hour_ahead_the_old_time_goes_on_at_once(bench: PairBench) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 30)
    bench.drive(BEGIN_S + 3600, BEGIN_S + 3660)
    before = bench.answers.status().checks
    bench.drive(BEGIN_S + 30, BEGIN_S + 60)
    assert bench.answers.status().checks >= before + 4
    assert not bench.pair.stream.held.pairs


def test_a_worker_that_takes_its_time_while_time_steps_back_is_pending_and_holds_up_nothing(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state", worker=SlowWorker)
    assert isinstance(bench.worker, SlowWorker)

    def catch_up() -> None:
        for _ in range(100):
            bench.worker.work(share=1.0)  # type: ignore[attr-defined]
            bench.settle()

    bench.drive(BEGIN_S, BEGIN_S + 60)
    catch_up()
    for half_s in range(2 * BEGIN_S, 2 * BEGIN_S + 60):
        bench.hold(frame_pair_at(half_s * NS_PER_S // 2))
    catch_up()
    assert not bench.pair.stream.held.pairs
    assert ("monitor", "not_awaited") not in bench.losses
    assert bench.health == "healthy"


@pytest.mark.fault("the mount moves while the vehicle stands", "not green three periods later, and red once it drives")
def test_a_mount_that_moves_while_the_vehicle_stands(bench: PairBench) -> None:
    bench.drive(BEGIN_S, STEP_S - 40)
    bench.drive(STEP_S - 40, STEP_S, speed_mps=0.0)
    assert bench.health == "healthy"
    before = bench.store.state.monitor.evidence
    bench.drive(STEP_S - 20, STEP_S, speed_mps=0.0)
    assert bench.store.state.monitor.evidence == before, "of one place there is one check"
    bench.drive(STEP_S, STEP_S + 20, speed_mps=0.0)
    assert bench.health == "suspect"
    bench.drive(STEP_S + 20, STEP_S + 120, speed_mps=0.0)
    assert bench.health == "suspect", "what a standing vehicle sees may be a lorry that parked in front of it"
    bench.drive(STEP_S + 120, STEP_S + 150)
    assert "miscalibrated" in [entry.code for entry in bench.entries("state")]


@pytest.mark.fault(
    "the mount was moved while the service was off, and the vehicle stands", "it is never called healthy"
)
def test_a_mount_that_was_moved_before_a_start_at_a_standstill(bench: PairBench) -> None:
    bench.drive(BEGIN_S, STEP_S - 10)
    assert bench.health == "healthy"
    bench.restart()
    entered = len(bench.entries("state"))
    bench.drive(STEP_S, STEP_S + 120, speed_mps=0.0)
    assert "healthy" not in [entry.code for entry in bench.entries("state")[entered:]]
    assert bench.health == "suspect"


@pytest.mark.fault("windows that come to nothing", "after three in a row, health says so")
def test_a_window_that_is_lost_is_answered_for_and_three_in_a_row_are_reported(bench: PairBench) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 45)
    bench.recorder.loses = True
    bench.drive(BEGIN_S + 45, BEGIN_S + 90)
    assert (bench.losses["window", "not_recorded"], bench.answers.health_reply.state) == (1, "healthy")
    bench.drive(BEGIN_S - 200, BEGIN_S - 60)
    reported = bench.answers.health_reply
    assert (reported.state, [reason.code for reason in reported.reasons]) == ("degraded", ["windows_in_vain"])
    bench.recorder.loses = False
    bench.drive(BEGIN_S - 60, BEGIN_S)
    assert bench.answers.health_reply.state == "healthy"


def test_a_window_that_comes_to_nothing_is_no_check(bench: PairBench) -> None:
    bench.worker.window_fault = Reason("worker_failed", "The worker failed on this window 2 times.")
    bench.worker.fault = Reason("bad_model", "no network")
    bench.drive(BEGIN_S, BEGIN_S + 60)
    reported = bench.answers.health_reply
    assert (reported.state, reported.age_s, reported.evaluated_ns) == ("unknown", None, None)


@pytest.mark.fault("checks that never complete, for whatever reason", "after three periods nothing is green")
def test_without_a_completed_check_in_three_periods_nothing_is_green(
    bench: PairBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 60)
    assert bench.answers.health_reply.state == "healthy"
    bench.check_clocks(16.0)
    reported = bench.answers.health_reply
    assert (reported.state, reported.level) == ("degraded", 1)
    assert [reason.code for reason in reported.reasons] == ["overdue_data", "last_known"]
    assert "no camera frames come" in reported.reasons[0].text
    bench.check_clocks(601.0)
    assert bench.health == "stale"
    bench.drive(BEGIN_S + 60, BEGIN_S + 72)
    assert bench.answers.health_reply.state == "healthy"
    # What nobody has renewed is not green either, whatever it says.
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 60.0)
    stuck = bench.answers.health_reply
    assert (stuck.state, stuck.reasons[-1].code) == ("degraded", "service_stuck")


@pytest.mark.fault("a state from the future", "it is not green")
@pytest.mark.parametrize("setback_s", [400 * 86_400, -100 * 86_400, -3600])
def test_a_state_from_another_time_is_not_green(
    bench: PairBench, monkeypatch: pytest.MonkeyPatch, setback_s: int
) -> None:
    bench.drive(BEGIN_S, BEGIN_S + 60)
    bench.store.save()
    now_ns = time.time_ns()
    monkeypatch.setattr(time, "time_ns", lambda: now_ns - setback_s * NS_PER_S)
    bench.restart()
    reported = bench.answers.health_reply
    assert reported.state == "unknown"
    assert reported.age_s is None or reported.age_s >= 0.0
    assert [reason.code for reason in reported.reasons] == ["restarted", "last_known"]
    bench.drive(BEGIN_S + 60, BEGIN_S + 72)
    assert bench.answers.health_reply.state == "healthy"
