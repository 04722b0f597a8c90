"""What was asked about a pair, in the order in which it was asked: no answer counts before those in front of it.

How long an answer takes is a matter of the machine; what it changes must not be. So every question has a sensor time
from which on its answer counts in the choice of further pairs, fixed when it is asked: before a pair of that time is
looked at the service waits, and a drive that is replayed, at any rate, on any machine, is judged in the same way.
Answers are served the moment they come; only the stream waits.

Every question ends: with its answer, or when it has waited for longer than whoever answers may take. One that was lost
must not hold up those behind it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

Effect = Callable[[], None]
"""What an answer changes in the choice of further pairs; run by the thread that chooses them."""

Take = Callable[[], Effect | None]
"""Takes an answer, and says what it changes; run by the thread that decides."""


@dataclass(slots=True, eq=False)
class Question:
    """One of them.

    Attributes:
        due_ns: sensor time of the first pair that is looked at with the answer known.
        expires_s: steady clock after which no answer is waited for.
        name: the window it is about, empty for a check.
        take: takes the answer; None until it has come.
        effect: what it changes, once it was taken.
    """

    due_ns: int
    expires_s: float
    name: str = ""
    take: Take | None = None
    effect: Effect | None = None
    taken: bool = False


class DecisionQueue:
    """The questions of one pair. One thread asks and lets answers take effect, one thread answers."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._questions: deque[Question] = deque()
        self._untaken: deque[Question] = deque()

    def ask(self, due_ns: int, expires_s: float, name: str = "") -> Question:
        """A question is asked now. It is due no earlier than those before it, for which its answer has to wait."""
        with self._lock:
            before_ns = self._questions[-1].due_ns if self._questions else due_ns
            question = Question(max(due_ns, before_ns), expires_s, name)
            self._questions.append(question)
            self._untaken.append(question)
            return question

    def about(self, name: str) -> Question | None:
        """The question about a window that has no answer yet."""
        with self._lock:
            return next((one for one in self._untaken if one.name == name and one.take is None), None)

    def answer(self, question: Question, take: Take) -> None:
        """The answer to a question has come. The first one counts: it is taken now, or with the last one in front."""
        if question.take is None:
            question.take = take
        self._take_answered()

    def expire(self, monotonic_s: float, lost: Callable[[Question], Take]) -> int:
        """Gives up what has waited for too long; `lost(question)` stands in for its answer. How many those were."""
        with self._lock:
            late = [one for one in self._untaken if one.take is None and one.expires_s <= monotonic_s]
        for question in late:
            question.take = lost(question)
        if late:
            self._take_answered()
        return len(late)

    @property
    def is_answered(self) -> bool:
        """Whether every answer has come and was taken."""
        with self._lock:
            return not self._untaken

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

    def bring_forward(self, stamp_ns: int) -> None:
        """Sensor time stepped back, to this stamp: whatever waits is due with the first pair of the new time."""
        with self._lock:
            for question in self._questions:
                question.due_ns = min(question.due_ns, stamp_ns)

    def _take_answered(self) -> None:
        while True:
            with self._lock:
                first = self._untaken[0] if self._untaken else None
                if first is None or first.take is None:
                    return
            # The thread that answers is the only one that takes: outside the lock, the stream may ask meanwhile.
            first.effect = first.take()
            with self._lock:
                self._untaken.popleft()
                first.taken = True
