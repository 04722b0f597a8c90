"""Who sends on a stream, by the ids beside its messages."""

from __future__ import annotations

from itertools import count

import pytest

from coec.service.ingest.decoder import RECENT, REMEMBERED, TRIAL, Senders

A, B = b"a" * 16, b"b" * 16


def sent(senders: Senders, *ids: bytes) -> None:
    numbers = {sender: count(1) for sender in ids}
    for sender in ids:
        assert senders.lost_by(sender, next(numbers[sender])) == 0
        senders.took(sender)


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
        senders.took(number.to_bytes(16, "big"))
    assert len(senders.taking_turns) == RECENT
    assert len(senders._numbers) == REMEMBERED


def test_each_has_its_own_numbers() -> None:
    senders = Senders()
    lost = sum(
        senders.lost_by(sender, number + (900 if sender is B else 0)) for number in range(90) for sender in (A, B)
    )
    lost += sum(senders.lost_by(A, number) for number in range(95, 130))
    assert lost == 5


# --- senders that do not name themselves ---------------------------------------------------------------------------
P = 100_000_000
"""Period of a sensor, ns."""


def received(senders: Senders, *messages: tuple[int | None, int], origin: bytes = b"") -> int:
    """Messages as number and stamp; returns how many are known to be lost."""
    total = 0
    for number, stamp_ns in messages:
        sender, lost = senders.unnamed(origin, number, stamp_ns)
        senders.took(sender)
        total += lost
    return total


def run(first: int, count: int, stamp_ns: int) -> list[tuple[int | None, int]]:
    return [(first + index, stamp_ns + index * P) for index in range(count)]


def mixed(*runs: list[tuple[int | None, int]]) -> list[tuple[int | None, int]]:
    return [message for messages in zip(*runs, strict=True) for message in messages]


@pytest.mark.parametrize(
    ("first", "stamp_ns"),
    [(5000, 30_000_000), (100_000_000, -40 * P), (108, 30_000_000), (101, 20_000_000), (100, 30_000_000), (3, 7)],
    ids=["ahead", "far ahead, another clock", "a little ahead", "one ahead", "the same numbers", "behind"],
)
def test_two_that_number_by_themselves_are_two(first: int, stamp_ns: int) -> None:
    senders = Senders()
    assert received(senders, *run(60, 40, 0)) == 0
    lost = received(senders, *mixed(run(100, 12, 40 * P), run(first, 12, 40 * P + stamp_ns)))
    assert len(senders.taking_turns) >= 2
    assert lost == 0
    received(senders, *run(112, RECENT + 1, 52 * P))
    assert not senders.taking_turns, "only one sends"


def test_one_sender_whatever_happens_to_it_is_one() -> None:
    senders = Senders()
    assert received(senders, *run(1, 50, 0)) == 0
    assert received(senders, *run(1000, 50, 5000 * P)) == 949, "a gap"
    assert received(senders, *run(2000, 50, 6000 * P)) == 950, "and another"
    most_lost = [(20 * index, 6050 * P + 20 * index * P) for index in range(125, 200)]
    received(senders, *most_lost)
    assert senders.taking_turns == ()
    received(senders, *run(3981, 50, most_lost[-1][1] + P))
    assert received(senders, *run(0, 50, 61000 * P)) == 0, "a restart"
    assert received(senders, *run(0, 50, 62000 * P)) == 0, "and another"
    assert received(senders, *run(50, 50, 100 * P)) == 0, "a clock that steps back"
    late = [(100, 150 * P), (103, 153 * P), (101, 151 * P), (102, 152 * P), (102, 152 * P), *run(104, 20, 154 * P)]
    assert received(senders, *late) == 0, "messages that overtake others, and one that comes twice"
    assert received(senders, *[(None, stamp_ns) for _, stamp_ns in run(0, 50, 200 * P)]) == 0
    assert senders.taking_turns == ()
    assert not senders.on_trial


def test_a_restart_is_on_trial_until_it_has_sent_some() -> None:
    senders = Senders()
    received(senders, *run(100, 20, 0))
    trials = []
    for message in run(0, TRIAL + 1, 20 * P):
        received(senders, message)
        trials.append(senders.on_trial)
    assert trials == [*[True] * (TRIAL - 1), False, False]


def test_senders_without_numbers_are_distinguished_by_their_clocks() -> None:
    senders = Senders()
    for index in range(10):
        received(senders, (None, index * P), (None, 10**12 + index * P))
    assert len(senders.taking_turns) == 2


def test_senders_behind_different_routers_are_distinguished_whatever_they_report() -> None:
    senders = Senders()
    for index in range(10):
        for origin in (A, B):
            received(senders, (index, index * P), origin=origin)
    assert len(senders.taking_turns) == 2


def test_a_flood_of_numbers_takes_no_room() -> None:
    senders = Senders()
    received(senders, *[(number * 1000 % 7919, number) for number in range(5000)])
    assert len(senders._tracks) <= REMEMBERED
