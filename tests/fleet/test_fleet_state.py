"""A fleet as its last words tell it: order, ages, and what is never invented."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coec.errors import UsageError
from coec.fleet.fleet_state import RANKS, FleetFilter, FleetState, parse_states
from coec.schemas.keys import Keys
from support.messages import SENT_NS, heartbeat, packed_heartbeat

S = 1_000_000_000


def said(roster: FleetState, at_s: float, vehicle: str, pair: str = "front", **told: Any) -> None:
    roster.on_heartbeat(Keys("coec", vehicle).last(pair), packed_heartbeat(heartbeat(vehicle, pair, **told)), at_s)


def kept(roster: FleetState, at_s: float, wall_ns: int, vehicle: str, **told: Any) -> None:
    roster.restore(Keys("coec", vehicle).last("front"), packed_heartbeat(heartbeat(vehicle, **told)), at_s, wall_ns)


def order(roster: FleetState, now_s: float, chosen: FleetFilter | None = None) -> list[str]:
    return [pair.word.vehicle for pair in roster.now(now_s, chosen or FleetFilter()).pairs]


def test_the_most_urgent_comes_first() -> None:
    roster = FleetState()
    said(roster, 0.0, "parked", service="stopping")
    said(roster, 0.0, "well")
    said(roster, 0.0, "drifting", drift=(0.0, 0.4, 0.0, 0.0, 0.0, 0.0))
    said(roster, 0.0, "unknown", state="unknown")
    said(roster, 0.0, "red", state="miscalibrated")
    said(roster, 0.0, "suspect", state="suspect")
    said(roster, -1000.0, "silent")
    assert order(roster, 1.0) == ["red", "suspect", "silent", "unknown", "drifting", "well", "parked"]
    now = roster.now(1.0)
    assert now.states == {
        "miscalibrated": 1, "suspect": 1, "silent": 1, "unknown": 1, "healthy": 2, "parked": 1,
    }  # fmt: skip
    drifting = next(pair for pair in now.pairs if pair.word.vehicle == "drifting")
    assert drifting.worst == "ry"
    assert drifting.urgency == pytest.approx(0.8)


@pytest.mark.fault("a vehicle that says nothing any more", "its last state is shown as old, never as live")
def test_silence_never_reads_as_healthy() -> None:
    roster = FleetState()
    said(roster, 0.0, "a", period_s=10.0)
    said(roster, 0.0, "b", period_s=10.0)
    assert roster.now(24.9).states == {"healthy": 2}
    assert roster.now(25.1).states == {"silent": 2}
    assert roster.overdue(25.1, 1) == [("a", "front")]
    roster.on_liveliness("b", "front", is_there=False)
    assert roster.now(1.0).states == {"silent": 1, "healthy": 1}, "its token has gone"
    roster.on_liveliness("b", "front", is_there=True)
    assert roster.now(1.0).states == {"silent": 1, "healthy": 1}, "it is there, and has said nothing"
    said(roster, 2.0, "b", period_s=10.0)
    assert roster.now(3.0).states == {"healthy": 2}


def test_who_took_his_leave_is_parked_however_long_ago() -> None:
    roster = FleetState()
    kept(roster, 100.0, SENT_NS + 86_400 * S, "a", service="stopping", state="degraded")
    roster.on_liveliness("a", "front", is_there=False)
    (pair,) = roster.now(100.0).pairs
    assert (pair.standing, pair.word.state) == ("parked", "degraded")
    assert pair.said_s == pytest.approx(86_400.0)
    assert pair.looked_s == pytest.approx(86_404.0), "the age that it had, and the time since"


def test_a_parked_vehicle_that_was_red_stays_in_front() -> None:
    roster = FleetState()
    said(roster, 0.0, "well", state="suspect")
    said(roster, 0.0, "parked", service="stopping", state="miscalibrated")
    assert order(roster, 1.0) == ["parked", "well"]


def test_a_kept_word_does_not_replace_a_newer_one_and_a_clock_that_is_ahead_makes_no_age() -> None:
    roster = FleetState()
    said(roster, 10.0, "a", state="suspect", said_ns=SENT_NS + S)
    kept(roster, 11.0, SENT_NS, "a", state="healthy")
    assert roster.now(11.0).states == {"suspect": 1}
    kept(roster, 11.0, SENT_NS, "a", state="unknown", said_ns=SENT_NS + 3600 * S)
    (pair,) = roster.now(12.0).pairs
    assert pair.word.state == "unknown"
    assert pair.said_s == pytest.approx(1.0)


def test_a_word_as_it_is_said_stands_whatever_the_clock_of_its_vehicle_says() -> None:
    roster = FleetState()
    said(roster, 10.0, "a", state="suspect", said_ns=SENT_NS)
    said(roster, 11.0, "a", state="healthy", said_ns=SENT_NS - 3600 * S)
    assert roster.now(11.0).states == {"healthy": 1}


@pytest.mark.fault("a flood of invented vehicles", "a bounded number is kept, the rest counted")
def test_who_floods_takes_no_more_memory_than_a_fleet_does() -> None:
    roster = FleetState(most=3)
    for index in range(10):
        said(roster, 0.0, f"v{index}")
    said(roster, 1.0, "v0", state="suspect")
    now = roster.now(1.0)
    assert (now.known, now.refused) == (3, {"too_many_pairs": 7})
    assert now.pairs[0].word.state == "suspect", "those that are known are heard"


@pytest.mark.fault("a flood of words of the largest size", "their bytes are bounded as their number is")
def test_words_of_the_largest_size_take_no_more_memory_than_a_fleet_does(monkeypatch: pytest.MonkeyPatch) -> None:
    size = len(packed_heartbeat(heartbeat("v0", "front")))
    monkeypatch.setattr("coec.fleet.fleet_state.MAX_WORD_BYTES", 3 * size)
    roster = FleetState()
    for index in range(10):
        said(roster, 0.0, f"v{index}")
    said(roster, 1.0, "v0")
    assert (roster.now(1.0).known, roster.now(1.0).refused) == (3, {"too_many_pairs": 7})
    said(roster, 2.0, "v0", reasons=({"code": "suspect", "text": "x" * 300},))
    assert roster.now(2.0).refused == {"too_many_pairs": 7, "word_too_large": 1}


def test_what_is_no_word_is_counted() -> None:
    roster = FleetState()
    roster.on_heartbeat("coec/@v1/a/last/front", b"\xc1", 0.0)
    roster.restore("coec/@v1/b/last/front", packed_heartbeat(heartbeat("a")), 0.0, SENT_NS)
    assert roster.now(0.0).refused == {"word_malformed": 1, "word_of_another": 1}
    assert roster.now(0.0).known == 0


def test_a_filter_looks_at_what_is_shown() -> None:
    roster = FleetState()
    said(roster, -1000.0, "truck-1")
    said(roster, 0.0, "truck-2")
    said(roster, 0.0, "car-1", pair="rear")
    assert order(roster, 0.0, FleetFilter(frozenset({"healthy"}))) == ["car-1", "truck-2"]
    assert order(roster, 0.0, FleetFilter(text="truck")) == ["truck-1", "truck-2"]
    assert order(roster, 0.0, FleetFilter(text="1/rear")) == ["car-1"]
    now = roster.now(0.0, FleetFilter(text="truck"), most=1)
    assert (now.known, now.matching, len(now.pairs)) == (3, 2, 1)


def test_a_filter_names_states_that_there_are() -> None:
    assert parse_states(["silent", "healthy"], UsageError) == {"silent", "healthy"}
    with pytest.raises(UsageError, match="'well' is no state"):
        parse_states(["well"], UsageError)


@settings(max_examples=50)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["healthy", "suspect", "miscalibrated", "degraded", "stale", "unknown"]),
            st.sampled_from(["running", "stopping"]),
            st.floats(0.0, 500.0),
            st.floats(-2.0, 2.0),
        ),
        max_size=20,
    )
)
def test_whatever_comes_everybody_is_told_once_and_in_the_order_of_ranks(
    words: list[tuple[str, str, float, float]],
) -> None:
    roster = FleetState()
    for index, (state, service, at_s, drift) in enumerate(words):
        six = (drift, 0.0, 0.0, 0.0, 0.0, 0.0)
        said(roster, at_s, f"v{index}", state=state, service=service, drift=six)
    now = roster.now(500.0)
    assert sum(now.states.values()) == now.known == now.matching == len(words)
    told = [pair.word.state if pair.standing == "live" else pair.standing for pair in now.pairs]
    in_front = [
        state for state, pair in zip(told, now.pairs, strict=True) if pair.word.state != "miscalibrated"
        and not (pair.standing == "silent" and pair.word.state in ("suspect", "degraded"))
    ]  # fmt: skip
    assert [RANKS.index(state) for state in in_front] == sorted(RANKS.index(state) for state in in_front)
    assert all(pair.said_s >= 0.0 for pair in now.pairs)
