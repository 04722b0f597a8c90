"""Answers count in the order of the questions, and from a sensor time on that was fixed when they were asked."""

from __future__ import annotations

from itertools import permutations

import pytest

from coec.service.engine.schedule import Effect, PendingRequest, ResultSchedule


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_answers_are_taken_in_the_order_of_the_queries_and_act_when_they_are_due(order: tuple[int, ...]) -> None:
    decisions = ResultSchedule()
    taken: list[int] = []
    acted: list[int] = []
    requests = [decisions.submit(due_ns, expires_s=1.0) for due_ns in (50, 40, 60, 60)]

    def answer(number: int) -> Effect:
        taken.append(number)
        return lambda: acted.append(number)

    for come, number in enumerate(order):
        assert decisions.waits(60)
        decisions.answer(requests[number], lambda number=number: answer(number))  # type: ignore[misc]
        assert taken == list(range(len(taken)))
        assert set(taken) <= set(order[: come + 1])
    assert taken == [0, 1, 2, 3]
    assert not decisions.waits(60)
    steps = []
    for stamp_ns in (39, 40, 49, 50, 59, 60):
        decisions.settle(stamp_ns)
        steps.append(list(acted))
    # The second was asked behind the first, and is due with it.
    assert steps == [[], [], [], [0, 1], [0, 1], [0, 1, 2, 3]]


def test_only_what_is_due_is_waited_for() -> None:
    decisions = ResultSchedule()
    assert not decisions.waits(10**18)
    question = decisions.submit(50, expires_s=1.0)
    assert not decisions.waits(49)
    assert decisions.waits(50)
    decisions.answer(question, lambda: None)
    assert not decisions.waits(50)


def test_an_answer_that_was_not_pending_acts_on_the_next_pair() -> None:
    decisions = ResultSchedule()
    acted: list[int] = []
    question = decisions.submit(50, expires_s=1.0)
    decisions.settle(55)
    decisions.answer(question, lambda: lambda: acted.append(1))
    assert acted == []
    decisions.settle(56)
    decisions.settle(57)
    assert acted == [1]


def test_a_question_without_an_answer_does_not_hold_up_those_behind_it() -> None:
    decisions = ResultSchedule()
    acted: list[str] = []
    lost, other = decisions.submit(50, expires_s=10.0, name="w-1"), decisions.submit(60, expires_s=90.0)
    decisions.answer(other, lambda: lambda: acted.append("other"))
    assert decisions.waits(60)
    assert decisions.expire(9.9, lambda _: lambda: None) == 0
    reported = []

    def on_expired(request: PendingRequest) -> Effect:
        reported.append(request)
        return lambda: acted.append("lost")

    assert decisions.expire(10.0, on_expired) == 1
    assert reported == [lost]
    assert not decisions.waits(10**18)
    decisions.settle(60)
    assert acted == ["lost", "other"]
    decisions.answer(lost, lambda: lambda: acted.append("late"))
    decisions.settle(10**18)
    assert acted == ["lost", "other"], "the first answer counts"


def test_the_query_about_a_window_is_detected_until_it_is_answered() -> None:
    decisions = ResultSchedule()
    question = decisions.submit(50, 1.0, "w-1")
    assert decisions.about("w-1") is question
    assert decisions.about("w-2") is None
    decisions.answer(question, lambda: None)
    assert decisions.about("w-1") is None


def test_when_sensor_time_steps_back_whatever_waits_is_due_at_once() -> None:
    decisions = ResultSchedule()
    acted: list[int] = []
    requests = [decisions.submit(due_ns, expires_s=1.0) for due_ns in (1000, 2000)]
    assert not decisions.waits(10)
    decisions.bring_forward(10)
    assert decisions.waits(10)
    for number, question in enumerate(requests):
        decisions.answer(question, lambda number=number: lambda: acted.append(number))  # type: ignore[misc]
    decisions.settle(10)
    assert acted == [0, 1]
    assert decisions.submit(20, 1.0).due_ns == 20
