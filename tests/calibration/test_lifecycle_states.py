"""The machine of health: every edge of its table, and what the table as a whole promises."""

import pytest

from coec.calibration.lifecycle import MEANING, TRANSITIONS, Event, HealthState, markdown
from coec.calibration.lifecycle.states import STATES
from conftest import REPOSITORY
from generate.service import health_page

U, H, S, M, D, A = HealthState

EDGES: dict[Event, tuple[HealthState, ...]] = {
    # from:                   unknown, healthy, suspect, miscalibrated, degraded, stale
    Event.CONFIRMED_BY_WINDOW: (H, H, H, H, H, H),
    Event.CONFIRMED_EARLIER: (U, U, U, U, U, U),
    Event.CONTRADICTED: (M, M, M, M, M, M),
    Event.STEP_SUSPECTED: (S, S, S, M, S, S),
    Event.REFUSED_ELSEWHERE: (S, S, S, M, S, S),
    Event.CLEAR: (H, H, H, S, H, H),
    Event.NO_OBJECTION: (U, H, S, S, U, U),
    Event.SUSPECTED: (S, S, S, M, S, S),
    Event.MOUNT_MOVED: (M, M, M, M, M, M),
    Event.AT_ODDS: (D, D, S, M, D, D),
    Event.DATA_CAUSE: (D, D, D, M, D, D),
    Event.NOT_ACQUITTED: (D, D, S, M, D, D),
    Event.OVERDUE: (U, D, S, M, D, A),
    Event.AGED: (U, A, A, M, A, A),
    Event.REPLACED: (U, U, U, U, U, U),
    Event.TIME_STEPPED_BACK: (U, U, S, M, U, U),
    Event.RESTARTED: (U, U, S, M, U, U),
}


@pytest.mark.parametrize(
    ("event", "before", "after"),
    [
        pytest.param(event, before, after, id=f"{before.value}-{event.value}")
        for event, row in EDGES.items()
        for before, after in zip(HealthState, row, strict=True)
    ],
)
def test_edge(event: Event, before: HealthState, after: HealthState) -> None:
    assert TRANSITIONS[before, event] is after


def test_the_table_is_total_and_every_event_has_a_meaning() -> None:
    assert set(TRANSITIONS) == {(state, event) for state in HealthState for event in Event}
    assert set(MEANING) == set(Event)


def test_green_is_only_reached_by_looking() -> None:
    ways = {event for (before, event), after in TRANSITIONS.items() if after is H and before is not H}
    assert ways == {Event.CONFIRMED_BY_WINDOW, Event.CLEAR}


def test_silence_and_bad_data_hide_no_red() -> None:
    silent = (Event.OVERDUE, Event.AGED, Event.TIME_STEPPED_BACK, Event.RESTARTED)
    for event in (*silent, Event.DATA_CAUSE, Event.REFUSED_ELSEWHERE, Event.SUSPECTED):
        assert TRANSITIONS[M, event] is M


def test_whoever_has_not_looked_is_not_green() -> None:
    for event in (Event.OVERDUE, Event.AGED, Event.TIME_STEPPED_BACK, Event.RESTARTED, Event.REPLACED):
        assert H not in {TRANSITIONS[state, event] for state in HealthState}


def test_only_a_moved_mount_is_red() -> None:
    ways = {event for (before, event), after in TRANSITIONS.items() if after is M and before is not M}
    assert ways == {Event.CONTRADICTED, Event.MOUNT_MOVED}


def test_every_state_can_be_reached_and_left() -> None:
    for state in HealthState:
        assert any(after is state for (before, _), after in TRANSITIONS.items() if before is not state)
        assert any(after is not state for (before, _), after in TRANSITIONS.items() if before is state)


def test_the_page_of_the_documentation_is_that_of_the_code() -> None:
    committed = (REPOSITORY / "docs" / "health.md").read_text(encoding="utf-8")
    assert committed == health_page(), "run: PYTHONPATH=docs:service python -m generate docs"
    assert markdown() in committed
    assert all(f"`{state.value}`: {STATES[state]}" in committed for state in HealthState)
