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


def reported(fleet: FleetState, at_s: float, vehicle: str, pair: str = "front", **report: Any) -> None:
    fleet.on_heartbeat(Keys("coec", vehicle).last(pair), packed_heartbeat(heartbeat(vehicle, pair, **report)), at_s)


def retained(fleet: FleetState, at_s: float, wall_ns: int, vehicle: str, **report: Any) -> None:
    fleet.restore(Keys("coec", vehicle).last("front"), packed_heartbeat(heartbeat(vehicle, **report)), at_s, wall_ns)


def order(fleet: FleetState, now_s: float, selected: FleetFilter | None = None) -> list[str]:
    return [pair.word.vehicle for pair in fleet.now(now_s, selected or FleetFilter()).pairs]


def test_the_most_urgent_comes_first() -> None:
    fleet = FleetState()
    reported(fleet, 0.0, "parked", service="stopping")
    reported(fleet, 0.0, "well")
    reported(fleet, 0.0, "drifting", drift=(0.0, 0.4, 0.0, 0.0, 0.0, 0.0))
    reported(fleet, 0.0, "unknown", state="unknown")
    reported(fleet, 0.0, "red", state="miscalibrated")
    reported(fleet, 0.0, "suspect", state="suspect")
    reported(fleet, -1000.0, "silent")
    assert order(fleet, 1.0) == ["red", "suspect", "silent", "unknown", "drifting", "well", "parked"]
    now = fleet.now(1.0)
    assert now.states == {
        "miscalibrated": 1, "suspect": 1, "silent": 1, "unknown": 1, "healthy": 2, "parked": 1,
    }  # fmt: skip
    drifting = next(pair for pair in now.pairs if pair.word.vehicle == "drifting")
    assert drifting.worst == "ry"
    assert drifting.urgency == pytest.approx(0.8)


@pytest.mark.fault("a vehicle that says nothing any more", "its last state is shown as old, never as live")
def test_silence_never_reads_as_healthy() -> None:
    fleet = FleetState()
    reported(fleet, 0.0, "a", period_s=10.0)
    reported(fleet, 0.0, "b", period_s=10.0)
    assert fleet.now(24.9).states == {"healthy": 2}
    assert fleet.now(25.1).states == {"silent": 2}
    assert fleet.overdue(25.1, 1) == [("a", "front")]
    fleet.on_liveliness("b", "front", is_there=False)
    assert fleet.now(1.0).states == {"silent": 1, "healthy": 1}, "its token has gone"
    fleet.on_liveliness("b", "front", is_there=True)
    assert fleet.now(1.0).states == {"silent": 1, "healthy": 1}, "it is there, and has said nothing"
    reported(fleet, 2.0, "b", period_s=10.0)
    assert fleet.now(3.0).states == {"healthy": 2}


def test_who_took_his_leave_is_parked_however_long_ago() -> None:
    fleet = FleetState()
    retained(fleet, 100.0, SENT_NS + 86_400 * S, "a", service="stopping", state="degraded")
    fleet.on_liveliness("a", "front", is_there=False)
    (pair,) = fleet.now(100.0).pairs
    assert (pair.standing, pair.word.state) == ("parked", "degraded")
    assert pair.said_s == pytest.approx(86_400.0)
    assert pair.looked_s == pytest.approx(86_404.0), "the age that it had, and the time since"


def test_a_parked_vehicle_that_was_red_stays_in_front() -> None:
    fleet = FleetState()
    reported(fleet, 0.0, "well", state="suspect")
    reported(fleet, 0.0, "parked", service="stopping", state="miscalibrated")
    assert order(fleet, 1.0) == ["parked", "well"]


def test_a_retained_text_does_not_replace_a_newer_one_and_a_clock_that_is_ahead_makes_no_age() -> None:
    fleet = FleetState()
    reported(fleet, 10.0, "a", state="suspect", said_ns=SENT_NS + S)
    retained(fleet, 11.0, SENT_NS, "a", state="healthy")
    assert fleet.now(11.0).states == {"suspect": 1}
    retained(fleet, 11.0, SENT_NS, "a", state="unknown", said_ns=SENT_NS + 3600 * S)
    (pair,) = fleet.now(12.0).pairs
    assert pair.word.state == "unknown"
    assert pair.said_s == pytest.approx(1.0)


def test_a_text_as_it_is_reported_stands_whatever_the_clock_of_its_vehicle_reports() -> None:
    fleet = FleetState()
    reported(fleet, 10.0, "a", state="suspect", said_ns=SENT_NS)
    reported(fleet, 11.0, "a", state="healthy", said_ns=SENT_NS - 3600 * S)
    assert fleet.now(11.0).states == {"healthy": 1}


@pytest.mark.fault("a flood of invented vehicles", "a bounded number is kept, the rest counted")
def test_who_floods_takes_no_more_memory_than_a_fleet_does() -> None:
    fleet = FleetState(most=3)
    for index in range(10):
        reported(fleet, 0.0, f"v{index}")
    reported(fleet, 1.0, "v0", state="suspect")
    now = fleet.now(1.0)
    assert (now.known, now.refused) == (3, {"too_many_pairs": 7})
    assert now.pairs[0].word.state == "suspect", "those that are known are heard"


@pytest.mark.fault("a flood of words of the largest size", "their bytes are bounded as their number is")
def test_text_of_the_largest_size_take_no_more_memory_than_a_fleet_does(monkeypatch: pytest.MonkeyPatch) -> None:
    size = len(packed_heartbeat(heartbeat("v0", "front")))
    monkeypatch.setattr("coec.fleet.fleet_state.MAX_WORD_BYTES", 3 * size)
    fleet = FleetState()
    for index in range(10):
        reported(fleet, 0.0, f"v{index}")
    reported(fleet, 1.0, "v0")
    assert (fleet.now(1.0).known, fleet.now(1.0).refused) == (3, {"too_many_pairs": 7})
    reported(fleet, 2.0, "v0", reasons=({"code": "suspect", "text": "x" * 300},))
    assert fleet.now(2.0).refused == {"too_many_pairs": 7, "word_too_large": 1}


def test_what_is_no_word_is_counted() -> None:
    fleet = FleetState()
    fleet.on_heartbeat("coec/@v1/a/last/front", b"\xc1", 0.0)
    fleet.restore("coec/@v1/b/last/front", packed_heartbeat(heartbeat("a")), 0.0, SENT_NS)
    assert fleet.now(0.0).refused == {"word_malformed": 1, "word_of_another": 1}
    assert fleet.now(0.0).known == 0


def test_a_filter_checks_what_is_shown() -> None:
    fleet = FleetState()
    reported(fleet, -1000.0, "truck-1")
    reported(fleet, 0.0, "truck-2")
    reported(fleet, 0.0, "car-1", pair="rear")
    assert order(fleet, 0.0, FleetFilter(frozenset({"healthy"}))) == ["car-1", "truck-2"]
    assert order(fleet, 0.0, FleetFilter(text="truck")) == ["truck-1", "truck-2"]
    assert order(fleet, 0.0, FleetFilter(text="1/rear")) == ["car-1"]
    now = fleet.now(0.0, FleetFilter(text="truck"), most=1)
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
def test_whatever_comes_everybody_is_reported_once_and_in_the_order_of_ranks(
    text: list[tuple[str, str, float, float]],
) -> None:
    fleet = FleetState()
    for index, (state, service, at_s, drift) in enumerate(text):
        six = (drift, 0.0, 0.0, 0.0, 0.0, 0.0)
        reported(fleet, at_s, f"v{index}", state=state, service=service, drift=six)
    now = fleet.now(500.0)
    assert sum(now.states.values()) == now.known == now.matching == len(text)
    report = [pair.word.state if pair.standing == "live" else pair.standing for pair in now.pairs]
    in_front = [
        state for state, pair in zip(report, now.pairs, strict=True) if pair.word.state != "miscalibrated"
        and not (pair.standing == "silent" and pair.word.state in ("suspect", "degraded"))
    ]  # fmt: skip
    assert [RANKS.index(state) for state in in_front] == sorted(RANKS.index(state) for state in in_front)
    assert all(pair.said_s >= 0.0 for pair in now.pairs)
