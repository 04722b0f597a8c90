"""What pairs say is taken in one order, whichever is known first."""

from __future__ import annotations

import random

import pytest

from coec.service.engine.schedule import MOST_WAITING, SILENT_NS, ReportSchedule

S = 1_000_000_000
PAIRS = ("front", "left", "rear")


def _taken(order: ReportSchedule[str], *, silent: bool = False) -> list[str]:
    result = []
    while (reported := order.take(all_are_silent=silent)) is not None:
        result.append(reported.what)
        order.finish(reported)
    return result


@pytest.mark.fault("answers of several pairs overtake each other", "the rig combines them in the same order")
@pytest.mark.parametrize("seed", range(20))
def test_the_order_of_arrival_changes_nothing(seed: int) -> None:
    """Each pair asks at its times, and goes on once it has its answers; how long these take is drawn."""
    rng = random.Random(seed)
    reported = {
        pair: [(5 * turn + 2 * place, f"{pair} {turn}") for turn in range(8)] for place, pair in enumerate(PAIRS)
    }
    order: ReportSchedule[str] = ReportSchedule()
    result: list[str] = []
    place = dict.fromkeys(PAIRS, 0)
    for pair in PAIRS:
        order.report_time(pair, -S, waits=False)
    while any(at <= 60 for at in place.values()):
        slowest = min(place.values())
        pair = rng.choice([one for one in PAIRS if place[one] <= min(slowest + 2, 60)])
        at_s = place[pair]
        due = [what for due_s, what in reported[pair] if due_s == at_s]
        order.report_time(pair, at_s * S, waits=bool(due))
        if rng.random() < 0.3:
            result += _taken(order)
        for what in due:
            order.put(pair, at_s * S, what)
        order.report_time(pair, at_s * S, waits=False)
        place[pair] += 1
    result += _taken(order)
    expected = sorted((due_s, pair, what) for pair, all_of in reported.items() for due_s, what in all_of)
    assert result == [what for _, _, what in expected]
    assert not order.losses


def test_nothing_is_taken_before_all_pairs_have_passed_it() -> None:
    order: ReportSchedule[str] = ReportSchedule()
    for pair in PAIRS:
        order.report_time(pair, 0, waits=False)
    order.put("front", 2 * S, "a")
    order.report_time("front", 2 * S, waits=False)
    order.report_time("left", 2 * S, waits=False)
    assert _taken(order) == []
    order.report_time("rear", 2 * S, waits=True)
    assert _taken(order) == []
    order.report_time("rear", 2 * S, waits=False)
    assert _taken(order) == ["a"]
    assert order.taken_ns == 2 * S


@pytest.mark.fault("one camera of a rig falls silent", "the rig goes on without it after 3 s of driving")
def test_a_pair_whose_streams_have_stopped_is_not_waited_for() -> None:
    order: ReportSchedule[str] = ReportSchedule()
    for pair in PAIRS:
        order.report_time(pair, 0, waits=False)
    order.put("front", S, "a")
    for pair in PAIRS[:2]:
        order.report_time(pair, SILENT_NS, waits=False)
    assert _taken(order) == []
    for pair in PAIRS[:2]:
        order.report_time(pair, SILENT_NS + S, waits=False)
    assert _taken(order) == ["a"]


def test_a_pair_that_waits_for_an_answer_is_waited_for_however_far_the_others_are() -> None:
    order: ReportSchedule[str] = ReportSchedule()
    order.report_time("front", 0, waits=False)
    order.report_time("left", 0, waits=False)
    order.report_time("left", 5 * S, waits=True)
    order.put("front", 5 * S, "a")
    order.report_time("front", 60 * S, waits=False)
    assert _taken(order) == []
    order.put("left", 5 * S, "b")
    order.report_time("left", 5 * S, waits=False)
    order.report_time("front", 60 * S, waits=False)
    assert _taken(order) == ["a", "b"]


def test_what_comes_late_counts_and_is_counted() -> None:
    order: ReportSchedule[str] = ReportSchedule()
    order.report_time("front", 10 * S, waits=False)
    order.put("left", 5 * S, "late")
    assert _taken(order) == ["late"]
    assert order.losses == {"late": 1}


def test_once_all_streams_have_stopped_everything_is_taken() -> None:
    order: ReportSchedule[str] = ReportSchedule()
    for pair in PAIRS:
        order.report_time(pair, 0, waits=False)
    order.put("left", 5 * S, "b")
    order.put("front", 5 * S, "a")
    assert _taken(order) == []
    assert _taken(order, silent=True) == ["a", "b"]


def test_a_step_back_comes_after_what_was_reported_before_it() -> None:
    order: ReportSchedule[str] = ReportSchedule()
    for pair in PAIRS:
        order.report_time(pair, 100 * S, waits=False)
    order.put("rear", 105 * S, "b")
    order.put("front", 104 * S, "a")
    order.step_back(7 * S, "back")
    assert _taken(order) == ["a", "b", "back"]
    order.put("front", 12 * S, "c")
    for pair in PAIRS:
        order.report_time(pair, 12 * S, waits=False)
    assert _taken(order) == ["c"]


@pytest.mark.fault("a pair floods the rig while another holds it up", "bounded, and counted")
def test_what_waits_is_bounded() -> None:
    order: ReportSchedule[str] = ReportSchedule()
    order.report_time("front", 0, waits=False)
    order.report_time("left", 1, waits=True)
    for number in range(MOST_WAITING + 3):
        order.put("front", S + number, "x")
    assert order.losses == {"overrun": 3}
