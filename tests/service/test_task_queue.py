"""Work that another thread is asked to do is begun in time, or not at all."""

from __future__ import annotations

import threading

import pytest

from coec.service.task_queue import COMMANDS_WAITING, BusyError, DeferredCall, TaskQueue


def test_what_nobody_waits_for_any_more_is_not_done() -> None:
    done: list[int] = []
    handed = DeferredCall(lambda: done.append(1))
    with pytest.raises(BusyError, match="nothing was done"):
        handed.result(0.0)
    handed.run()
    assert done == []


def test_what_was_started_in_time_is_waited_for() -> None:
    started, go_on = threading.Event(), threading.Event()

    def work() -> str:
        started.set()
        assert go_on.wait(10.0)
        return "done"

    handed = DeferredCall(work)
    other = threading.Thread(target=handed.run)
    other.start()
    assert started.wait(10.0)
    waits = threading.Timer(0.0, go_on.set)
    waits.start()
    assert handed.result(10.0) == "done"
    other.join()
    waits.join()


def test_what_the_work_raises_is_raised_where_it_was_requested() -> None:
    handed = DeferredCall(lambda: 1 // 0)
    handed.run()
    with pytest.raises(ZeroDivisionError):
        handed.result(1.0)


@pytest.mark.fault("a flood of `calibrate`", "it is refused, and pairing is not held up")
def test_a_flood_of_commands_is_refused_and_answers_are_not_held_up() -> None:
    mailbox = TaskQueue()
    asking = [threading.Thread(target=_requested, args=(mailbox,)) for _ in range(COMMANDS_WAITING)]
    for thread in asking:
        thread.start()
    while mailbox._commands < COMMANDS_WAITING:
        threading.Event().wait(0.001)
    with pytest.raises(BusyError, match="Too many commands"):
        mailbox.call_and_wait(lambda: None, 30.0)
    answered: list[str] = []
    mailbox.post(lambda: answered.append("answer"))
    while (item := mailbox.take(0.0)) is not None:
        item()
    assert answered == ["answer"]
    for thread in asking:
        thread.join()
    assert mailbox._commands == 0


def _requested(mailbox: TaskQueue) -> None:
    mailbox.call_and_wait(lambda: None, 30.0)
