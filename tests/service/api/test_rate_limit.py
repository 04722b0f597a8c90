"""How often a sender may give commands."""

from __future__ import annotations

import pytest

from coec.service.api.command_execution import BURST, PER_S, SENDERS, RateLimit


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def accepted(limit: RateLimit, sender: str, count: int) -> int:
    return sum(limit.take(sender) == 0.0 for _ in range(count))


def test_a_burst_is_taken_and_then_one_after_the_other() -> None:
    clock = Clock()
    limit = RateLimit(clock=clock)
    assert accepted(limit, "a", 10 * BURST) == BURST
    wait_s = limit.take("a")
    assert 0.0 < wait_s <= 1.0 / PER_S
    clock.now_s += wait_s
    assert accepted(limit, "a", 5) == 1
    clock.now_s += 1e6
    assert accepted(limit, "a", 10 * BURST) == BURST


def test_senders_do_not_take_each_others_turns() -> None:
    limit = RateLimit(clock=Clock())
    assert accepted(limit, "a", 10 * BURST) == BURST
    assert accepted(limit, "b", 10 * BURST) == BURST


@pytest.mark.fault("a flood under invented names", "they gain little, and take no memory")
def test_invented_names_gain_little_and_take_no_memory() -> None:
    clock = Clock()
    limit = RateLimit(clock=clock)
    assert accepted(limit, "operator", 1) == 1
    taken = sum(limit.take(f"name {number}") == 0.0 for number in range(10_000))
    assert taken == SENDERS - 1 + BURST
    assert len(limit._buckets) == SENDERS
    assert accepted(limit, "operator", 1) == 1, "who was there before is not locked out"
    clock.now_s += BURST / PER_S
    assert accepted(limit, "newcomer", 10 * BURST) == BURST, "the names are forgotten when they are idle"
    assert len(limit._buckets) == 1


def test_who_has_proven_his_name_has_a_bucket_of_his_own_however_many_others_there_are() -> None:
    limit = RateLimit(clock=Clock())
    limit.reserve_for(["operator (certificate)"])
    for number in range(10 * SENDERS):
        for _ in range(BURST):
            limit.take(f"invented {number}")
    assert limit.take("invented anew") > 0.0
    assert limit.take("operator (certificate)") == 0.0


def test_who_is_named_again_keeps_what_is_left_to_him() -> None:
    limit = RateLimit(clock=Clock())
    limit.reserve_for(["operator", "fleet"])
    assert accepted(limit, "operator", BURST) == BURST
    limit.reserve_for(["operator"])
    assert limit.take("operator") > 0.0
    assert set(limit._reserved) == {"operator"}
