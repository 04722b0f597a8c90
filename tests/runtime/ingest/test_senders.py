"""Who sends on a stream, by the ids beside its messages."""

from __future__ import annotations

from itertools import count

from coec.runtime.ingest.senders import RECENT, REMEMBERED, Senders

A, B = b"a" * 16, b"b" * 16


def sent(senders: Senders, *ids: bytes) -> None:
    numbers = {sender: count(1) for sender in ids}
    for sender in ids:
        assert senders.lost_by(sender, next(numbers[sender])) == 0


def test_one_sender_and_one_that_follows_it_take_no_turns() -> None:
    senders = Senders()
    sent(senders, *[A] * 100, *[B] * 100)
    assert senders.taking_turns == ()


def test_a_single_message_of_another_shows() -> None:
    senders = Senders()
    sent(senders, *[A] * 100, B, A)
    assert senders.taking_turns == (A, B)


def test_it_is_over_when_nobody_else_has_sent_for_a_while() -> None:
    senders = Senders()
    sent(senders, *[A, B] * 50)
    sent(senders, *[A] * (RECENT - 1))
    assert len(senders.taking_turns) == 2
    sent(senders, *[A] * 2)
    assert not senders.taking_turns


def test_a_flood_of_ids_is_many_senders_and_takes_no_room() -> None:
    senders = Senders()
    for number in range(100_000):
        senders.lost_by(number.to_bytes(16, "big"), 1)
    assert len(senders.taking_turns) == RECENT
    assert len(senders._numbers) == REMEMBERED


def test_each_has_its_own_numbers() -> None:
    senders = Senders()
    lost = sum(
        senders.lost_by(sender, number + (900 if sender is B else 0)) for number in range(90) for sender in (A, B)
    )
    lost += sum(senders.lost_by(A, number) for number in range(95, 130))
    assert lost == 5
