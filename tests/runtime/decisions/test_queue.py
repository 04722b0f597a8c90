"""Answers count in the order of the questions, and from a sensor time on that was fixed when they were asked."""

from __future__ import annotations

from itertools import permutations

import pytest

from coec.runtime.decisions.queue import DecisionQueue, Effect


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_answers_are_taken_in_the_order_of_the_questions_and_act_when_they_are_due(order: tuple[int, ...]) -> None:
    decisions = DecisionQueue()
    taken: list[int] = []
    acted: list[int] = []
    questions = [decisions.ask(due_ns) for due_ns in (50, 40, 60, 60)]

    def answer(number: int) -> Effect:
        taken.append(number)
        return lambda: acted.append(number)

    for come, number in enumerate(order):
        assert decisions.waits(60)
        decisions.answer(questions[number], lambda number=number: answer(number))  # type: ignore[misc]
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
    decisions = DecisionQueue()
    assert not decisions.waits(10**18)
    question = decisions.ask(50)
    assert not decisions.waits(49)
    assert decisions.waits(50)
    decisions.answer(question, lambda: None)
    assert not decisions.waits(50)


def test_an_answer_that_was_not_awaited_acts_on_the_next_pair() -> None:
    decisions = DecisionQueue()
    acted: list[int] = []
    question = decisions.ask(50)
    decisions.settle(55)
    decisions.answer(question, lambda: lambda: acted.append(1))
    assert acted == []
    decisions.settle(56)
    decisions.settle(57)
    assert acted == [1]
