"""Results count in the order of the requests, and from a sensor time on that was fixed when they were submitted."""

from __future__ import annotations

from itertools import permutations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from coec.service.engine.schedule import Request, Schedule

Requests = Schedule[str, str, str]


def conclude(schedule: Requests) -> list[str]:
    """What the engine does with results; each changes what its subject says."""
    concluded = []
    while (request := schedule.next_answered()) is not None:
        concluded.append(request.subject)
        schedule.conclude(request, request.subject)
    return concluded


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_results_are_concluded_in_the_order_of_the_requests_and_act_when_they_are_due(order: tuple[int, ...]) -> None:
    schedule: Requests = Schedule()
    requests = [schedule.submit(str(number), due_ns, 1.0) for number, due_ns in enumerate((50, 40, 60, 60))]
    concluded: list[str] = []
    for come, number in enumerate(order):
        assert schedule.waits(60)
        schedule.answer(requests[number], "result")
        concluded += conclude(schedule)
        assert concluded == [str(place) for place in range(len(concluded))]
        assert {int(subject) for subject in concluded} <= set(order[: come + 1])
    assert concluded == ["0", "1", "2", "3"]
    assert not schedule.waits(60)
    # The second was submitted behind the first, and is due with it.
    due = [schedule.take_due(stamp_ns) for stamp_ns in (39, 40, 49, 50, 59, 60)]
    assert due == [[], [], [], ["0", "1"], [], ["2", "3"]]


def test_a_result_that_was_not_due_acts_on_the_next_frames() -> None:
    schedule: Requests = Schedule()
    request = schedule.submit("check", 50, 1.0)
    assert schedule.take_due(55) == []
    schedule.answer(request, "result")
    assert conclude(schedule) == ["check"]
    assert schedule.take_due(56) == ["check"]
    assert schedule.take_due(57) == []


def test_a_lost_request_does_not_hold_up_those_behind_it() -> None:
    schedule: Requests = Schedule()
    lost, other = schedule.submit("window", 50, 10.0), schedule.submit("check", 60, 90.0)
    schedule.answer(other, "result")
    assert conclude(schedule) == []
    assert schedule.waits(60)
    assert schedule.expired(9.9) == []
    assert schedule.expired(10.0) == [lost]
    assert schedule.answer(lost, "lost")
    assert conclude(schedule) == ["window", "check"]
    assert not schedule.waits(10**18)
    assert not schedule.answer(lost, "late"), "the first result counts"
    assert lost.result == "lost"


def test_the_request_about_a_window_is_known_until_it_is_answered() -> None:
    schedule: Requests = Schedule()
    request = schedule.submit("w-1", 50, 1.0)
    assert schedule.unanswered_about("w-1") is request
    assert schedule.unanswered_about("w-2") is None
    schedule.answer(request, "result")
    assert schedule.unanswered_about("w-1") is None


def test_when_sensor_time_steps_back_all_results_are_due_at_once_or_are_withdrawn() -> None:
    schedule: Requests = Schedule()
    requests = [schedule.submit(name, due_ns, 1.0) for name, due_ns in (("a", 1000), ("b", 2000))]
    assert not schedule.waits(10)
    schedule.bring_forward(10)
    assert schedule.waits(10)
    for request in requests:
        schedule.answer(request, "result")
    assert conclude(schedule) == ["a", "b"]
    assert schedule.take_due(10) == ["a", "b"]
    later = schedule.submit("c", 20, 1.0)
    assert later.due_ns == 20
    assert schedule.withdraw() == 1
    assert not schedule.answer(later, "result"), "it was withdrawn"
    assert (schedule.unanswered, schedule.next_answered()) == (0, None)


class AnyOrder(RuleBasedStateMachine):
    """Requests are submitted as sensor time goes on, answered in any order, expire, and are applied when due; compared
    with a plain list."""

    def __init__(self) -> None:
        super().__init__()
        self.schedule: Requests = Schedule()
        self.now_ns, self.number = 0, 0
        self.open: list[Request[str, str, str]] = []
        self.concluded: list[Request[str, str, str]] = []

    @rule(ahead_ns=st.integers(0, 20), expires_s=st.floats(0.0, 10.0))
    def submit(self, ahead_ns: int, expires_s: float) -> None:
        request = self.schedule.submit(str(self.number), self.now_ns + ahead_ns, expires_s)
        assert request.due_ns >= max((one.due_ns for one in (*self.concluded, *self.open)), default=request.due_ns)
        self.number += 1
        self.open.append(request)

    @precondition(lambda self: self.open)
    @rule(data=st.data(), result=st.text(max_size=1))
    def answer(self, data: st.DataObject, result: str) -> None:
        request = data.draw(st.sampled_from(self.open))
        first = request.result is None
        assert self.schedule.answer(request, result) is first
        assert (request.result == result) or not first
        expected = []
        while self.open and self.open[0].result is not None:
            expected.append(self.open.pop(0))
        assert conclude(self.schedule) == [one.subject for one in expected]
        self.concluded += expected

    @rule(now_s=st.floats(0.0, 10.0))
    def expire(self, now_s: float) -> None:
        late = [one for one in self.open if one.result is None and one.expires_s <= now_s]
        assert self.schedule.expired(now_s) == late

    @rule(step_ns=st.integers(0, 10))
    def evaluate(self, step_ns: int) -> None:
        self.now_ns += step_ns
        due = [one for one in self.concluded if one.due_ns <= self.now_ns]
        assert self.schedule.take_due(self.now_ns) == [one.subject for one in due]
        self.concluded = self.concluded[len(due) :]

    @rule(back_ns=st.integers(1, 50))
    def step_back(self, back_ns: int) -> None:
        self.now_ns -= back_ns
        self.schedule.bring_forward(self.now_ns)
        assert all(one.due_ns <= self.now_ns for one in (*self.concluded, *self.open))

    @invariant()
    def waits_only_for_what_is_due_and_missing(self) -> None:
        missing = [one for one in self.open if one.due_ns <= self.now_ns]
        assert self.schedule.waits(self.now_ns) is bool(missing)
        assert self.schedule.unanswered == len(self.open)


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=60, stateful_step_count=30, deadline=None, derandomize=True)
