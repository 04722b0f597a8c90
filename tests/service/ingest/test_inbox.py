"""What another thread asks of the engine is begun in time, or not at all."""

from __future__ import annotations

import threading

import pytest

from coec.service.ingest.inbox import COMMANDS_WAITING, BusyError, Inbox, PendingReply


def test_what_nobody_waits_for_any_more_is_not_started() -> None:
    reply = PendingReply()
    with pytest.raises(BusyError, match="nothing was done"):
        reply.result(0.0)
    assert not reply.begin()


def test_what_was_started_in_time_is_waited_for() -> None:
    reply = PendingReply()
    assert reply.begin()
    finish = threading.Timer(0.0, reply.finish, ("done",))
    finish.start()
    assert reply.result(10.0) == "done"
    finish.join()


def test_an_exception_is_raised_where_the_reply_is_received() -> None:
    reply = PendingReply()
    assert reply.begin()
    reply.fail(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        reply.result(1.0)


def test_events_come_before_samples_in_the_order_in_which_they_were_posted() -> None:
    inbox = Inbox({}, 0, lambda _: None)
    for number in range(3):
        inbox.post("front", number)
    assert [(posted.receiver, posted.event) for posted in iter(inbox.take_posted, None)] == [
        ("front", 0),
        ("front", 1),
        ("front", 2),
    ]
    assert inbox.take(0.0) is None


@pytest.mark.fault("a flood of `calibrate`", "it is refused, and pairing is not held up")
def test_a_flood_of_commands_is_refused_and_outcomes_are_not_held_up() -> None:
    inbox = Inbox({}, 0, lambda _: None)
    asking = [threading.Thread(target=inbox.request, args=("front", "command", 30.0)) for _ in range(COMMANDS_WAITING)]
    for thread in asking:
        thread.start()
    while inbox._commands["front"] < COMMANDS_WAITING:
        threading.Event().wait(0.001)
    with pytest.raises(BusyError, match="Too many commands"):
        inbox.request("front", "command", 30.0)
    inbox.post("front", "outcome")
    taken = []
    while (posted := inbox.take_posted()) is not None:
        taken.append(posted.event)
        if posted.reply is not None and posted.reply.begin():
            posted.reply.finish("done")
    assert taken == ["command"] * COMMANDS_WAITING + ["outcome"]
    for thread in asking:
        thread.join()
    assert inbox._commands["front"] == 0
