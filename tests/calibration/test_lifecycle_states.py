"""The machine of health: every edge of its table, and what the table as a whole promises."""

import pytest

from coec.calibration.state_machine import MEANING, STATES, TRANSITIONS, HealthEvent, HealthState, markdown
from conftest import REPOSITORY
from generate.service import health_page

U, H, S, M, D, A = HealthState

EDGES: dict[HealthEvent, tuple[HealthState, ...]] = {
    # from:                   unknown, healthy, suspect, miscalibrated, degraded, stale
    HealthEvent.CONFIRMED_BY_WINDOW: (H, H, H, H, H, H),
    HealthEvent.CONFIRMED_EARLIER: (U, U, U, U, U, U),
    HealthEvent.CONTRADICTED: (M, M, M, M, M, M),
    HealthEvent.STEP_SUSPECTED: (S, S, S, M, S, S),
    HealthEvent.REFUSED_ELSEWHERE: (S, S, S, M, S, S),
    HealthEvent.CLEAR: (H, H, H, S, H, H),
    HealthEvent.NO_OBJECTION: (U, H, S, S, U, U),
    HealthEvent.SUSPECTED: (S, S, S, M, S, S),
    HealthEvent.MOUNT_MOVED: (M, M, M, M, M, M),
    HealthEvent.AT_ODDS: (D, D, S, M, D, D),
    HealthEvent.DATA_CAUSE: (D, D, D, M, D, D),
    HealthEvent.NOT_ACQUITTED: (D, D, S, M, D, D),
    HealthEvent.OVERDUE: (U, D, S, M, D, A),
    HealthEvent.AGED: (U, A, A, M, A, A),
    HealthEvent.REPLACED: (U, U, U, U, U, U),
    HealthEvent.TIME_STEPPED_BACK: (U, U, S, M, U, U),
    HealthEvent.RESTARTED: (U, U, S, M, U, U),
}


@pytest.mark.parametrize(
    ("event", "before", "after"),
    [
        pytest.param(event, before, after, id=f"{before.value}-{event.value}")
        for event, row in EDGES.items()
        for before, after in zip(HealthState, row, strict=True)
    ],
)
def test_edge(event: HealthEvent, before: HealthState, after: HealthState) -> None:
    assert TRANSITIONS[before, event] is after


def test_the_table_is_total_and_every_event_has_a_meaning() -> None:
    assert set(TRANSITIONS) == {(state, event) for state in HealthState for event in HealthEvent}
    assert set(MEANING) == set(HealthEvent)


def test_green_is_only_reached_by_looking() -> None:
    directions = {event for (before, event), after in TRANSITIONS.items() if after is H and before is not H}
    assert directions == {HealthEvent.CONFIRMED_BY_WINDOW, HealthEvent.CLEAR}


def test_silence_and_bad_data_hide_no_red() -> None:
    silent = (HealthEvent.OVERDUE, HealthEvent.AGED, HealthEvent.TIME_STEPPED_BACK, HealthEvent.RESTARTED)
    for event in (*silent, HealthEvent.DATA_CAUSE, HealthEvent.REFUSED_ELSEWHERE, HealthEvent.SUSPECTED):
        assert TRANSITIONS[M, event] is M


def test_whoever_has_not_checked_is_not_green() -> None:
    for event in (
        HealthEvent.OVERDUE,
        HealthEvent.AGED,
        HealthEvent.TIME_STEPPED_BACK,
        HealthEvent.RESTARTED,
        HealthEvent.REPLACED,
    ):
        assert H not in {TRANSITIONS[state, event] for state in HealthState}


def test_only_a_moved_mount_is_red() -> None:
    directions = {event for (before, event), after in TRANSITIONS.items() if after is M and before is not M}
    assert directions == {HealthEvent.CONTRADICTED, HealthEvent.MOUNT_MOVED}


def test_every_state_can_be_reached_and_left() -> None:
    for state in HealthState:
        assert any(after is state for (before, _), after in TRANSITIONS.items() if before is not state)
        assert any(after is not state for (before, _), after in TRANSITIONS.items() if before is state)


def test_the_page_of_the_documentation_is_that_of_the_code() -> None:
    committed = (REPOSITORY / "docs" / "health.md").read_text(encoding="utf-8")
    assert committed == health_page(), "run: PYTHONPATH=docs:service python -m generate docs"
    assert markdown() in committed
    assert all(f"`{state.value}`: {STATES[state]}" in committed for state in HealthState)
