"""A pair as a state machine: events in, actions out, and predicates that change nothing."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest

from coec.calibration.frames.window import SliceClosed
from coec.calibration.types import Reason
from coec.service.engine.messages import (
    Evaluate,
    JobDone,
    Publish,
    SensorTime,
    SubmitCheck,
    SubmitSolve,
    Tick,
    WindowSubject,
)
from coec.service.engine.pair import Pair
from coec.service.ingest.pair_stream import StreamStatistics
from coec.service.recording.recorder import WindowLost, WindowRecorded
from coec.service.worker.worker_jobs import DEADLINE_S, Fate, JobOutcome, Kind
from support.vehicles import BEGIN_S, NS_PER_S, STEP_S, PairBench, frame_pair_at

REFUSED = JobOutcome(Fate.FAILED, None, Reason("bad_window", "It is empty."), 0.1)


@pytest.fixture
def bench(tmp_path: Path) -> PairBench:
    return PairBench(tmp_path / "state")


@pytest.fixture
def engine(bench: PairBench) -> Pair:
    return bench.pair.engine


def drive(engine: Pair, begin_s: float, end_s: float) -> list[object]:
    """The actions of frame pairs, twice a second; nothing outside does them."""
    actions: list[object] = []
    for stamp_ns in range(round(begin_s * NS_PER_S), round(end_s * NS_PER_S), NS_PER_S // 2):
        actions += engine.step(SensorTime(stamp_ns))
        if engine.is_waiting:
            return actions
        actions += engine.step(Evaluate(frame_pair_at(stamp_ns)))
    return actions


def waits(engine: Pair, stamp_ns: int) -> bool:
    """Whether frame pairs of this sensor time, to which the streams have come, have to wait."""
    engine.step(SensorTime(stamp_ns))
    return engine.is_waiting


def test_frame_pairs_make_a_check_and_its_result_is_waited_for_when_it_is_due(bench: PairBench, engine: Pair) -> None:
    actions = drive(engine, BEGIN_S, BEGIN_S + 20)
    (check,) = [action for action in actions if isinstance(action, SubmitCheck)]
    assert len(check.pairs) == 5
    assert waits(engine, check.request.due_ns)
    assert not waits(engine, check.request.due_ns - 1)
    engine.step(JobDone(check.request, REFUSED))
    assert not waits(engine, check.request.due_ns)
    engine.step(JobDone(check.request, REFUSED))
    assert bench.losses["monitor", "check_bad_window"] == 1, "a second outcome is ignored"


def test_a_window_ends_is_solved_once_it_is_recorded_and_may_be_lost(bench: PairBench, engine: Pair) -> None:
    closed: list[SliceClosed] = []
    for begin_s in range(BEGIN_S, BEGIN_S + 60):
        for action in drive(engine, begin_s, begin_s + 1):
            if isinstance(action, SubmitCheck):
                engine.step(JobDone(action.request, REFUSED))
            elif isinstance(action, SliceClosed):
                closed.append(action)
    (window,) = closed
    path = bench.context.folder.path(window.window_id)
    assert engine.step(WindowRecorded(window.window_id, path, True)) == [
        SubmitSolve(WindowSubject(window.window_id), path)
    ]
    assert engine.unanswered == 1
    engine.step(WindowLost(window.window_id))
    assert engine.unanswered == 0
    assert bench.losses["window", "not_recorded"] == 1


@pytest.mark.fault("a request whose result never comes", "it is given up, counted, and holds up nothing")
def test_a_result_that_never_comes_is_given_up(bench: PairBench, engine: Pair) -> None:
    (check,) = [action for action in drive(engine, BEGIN_S, BEGIN_S + 20) if isinstance(action, SubmitCheck)]
    bench.clock.ahead_s = DEADLINE_S[Kind.CHECK] + 60.0
    engine.step(Tick(100.0, StreamStatistics()))
    assert waits(engine, check.request.due_ns), "compiling does not count as waiting"
    actions = engine.step(Tick(0.0, StreamStatistics()))
    assert not waits(engine, check.request.due_ns)
    assert bench.losses["monitor", "unanswered"] == 1
    assert [type(action) for action in actions] == [Publish]


def test_predicates_change_nothing(tmp_path: Path) -> None:
    """They are put at any time, about any time, as often as one likes."""
    calm, curious = PairBench(tmp_path / "calm"), PairBench(tmp_path / "curious")
    for bench in (calm, curious):
        for begin_s in range(STEP_S - 60, STEP_S + 40, 5):
            bench.drive(begin_s, begin_s + 5)
            if bench is curious:
                engine = bench.pair.engine
                for ahead_s in (-100, 0, 3, 100):
                    engine.selector.ends_slice((begin_s + ahead_s) * NS_PER_S)
                    engine.selector.is_step_back((begin_s + ahead_s) * NS_PER_S)
                    engine.snapshot()
    assert curious.decisions() == calm.decisions()
    assert curious.worker.checked == calm.worker.checked
    assert "miscalibrated" in {code for _, code in calm.decisions()}


def test_events_and_actions_never_change() -> None:
    event = SensorTime(1)
    with pytest.raises(FrozenInstanceError):
        event.stamp_ns = 2  # type: ignore[misc]
