"""What the worker was asked to judge, in the order in which it was asked: no answer counts before those in front of it.

How long an answer takes is a matter of the machine; what it changes must not be. So every question has a sensor time
from which on its answer counts in the choice of further pairs, fixed when it is asked: before a pair of that time is
looked at the service waits, and a drive that is replayed, at any rate, on any machine, is judged in the same way.
Answers are served the moment they come; only the stream waits.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

Effect = Callable[[], None]
"""What an answer changes in the choice of further pairs; run by the thread that chooses them."""


@dataclass(slots=True, eq=False)
class Question:
    """One of them.

    Attributes:
        due_ns: sensor time of the first pair that is looked at with the answer known.
        answer: takes the answer and says what it changes; None until it has come.
        effect: what it changes, once it was taken.
    """

    due_ns: int
    answer: Callable[[], Effect | None] | None = None
    effect: Effect | None = None
    taken: bool = False


class DecisionQueue:
    """The questions of one pair. One thread asks and lets answers take effect; any thread may answer."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._questions: deque[Question] = deque()
        self._untaken: deque[Question] = deque()

    def ask(self, due_ns: int) -> Question:
        """A question is asked now. It is due no earlier than those before it, for which its answer has to wait."""
        with self._lock:
            before_ns = self._questions[-1].due_ns if self._questions else due_ns
            question = Question(max(due_ns, before_ns))
            self._questions.append(question)
            self._untaken.append(question)
            return question

    def answer(self, question: Question, answer: Callable[[], Effect | None]) -> None:
        """The answer to a question has come: it is taken now, or by whoever answers the last one in front of it."""
        with self._lock:
            question.answer = answer
            while self._untaken and (take := self._untaken[0].answer) is not None:
                first = self._untaken.popleft()
                first.effect = take()
                first.taken = True

    def waits(self, stamp_ns: int) -> bool:
        """Whether an answer has yet to come before a pair of this sensor time is looked at."""
        with self._lock:
            return bool(self._untaken) and self._untaken[0].due_ns <= stamp_ns

    def settle(self, stamp_ns: int) -> None:
        """A pair of this sensor time is about to be looked at: the answers that are due take effect."""
        with self._lock:
            due = []
            while self._questions and self._questions[0].taken and self._questions[0].due_ns <= stamp_ns:
                due.append(self._questions.popleft())
        for question in due:
            if question.effect is not None:
                question.effect()
