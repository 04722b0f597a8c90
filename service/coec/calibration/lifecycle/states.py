"""Health as an explicit state machine: six states (CONTRACT), the events, and one table that says what follows.

The table covers every state and event, and nothing else decides a change of state. `markdown()` renders it for the
documentation.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType


class HealthState(StrEnum):
    """States of `health` (CONTRACT). `unknown` means that nothing has been looked at."""

    UNKNOWN = "unknown"
    HEALTHY = "healthy"
    SUSPECT = "suspect"
    MISCALIBRATED = "miscalibrated"
    DEGRADED = "degraded"
    STALE = "stale"


STATES: Mapping[HealthState, str] = MappingProxyType(
    {
        HealthState.UNKNOWN: "what is served has not been checked",
        HealthState.HEALTHY: "what is served has been checked and agrees with the data",
        HealthState.SUSPECT: "something speaks against what is served; a window is being recorded to decide",
        HealthState.MISCALIBRATED: "what is served is wrong",
        HealthState.DEGRADED: "the data, or the service, do not allow a judgement",
        HealthState.STALE: "nothing has been checked for longer than `stale_after_s`",
    }
)


class HealthEvent(StrEnum):
    """What can happen to the health of a pair."""

    CONFIRMED_BY_WINDOW = "window_agrees"
    CONFIRMED_EARLIER = "window_agreed_earlier"
    CONTRADICTED = "window_contradicts"
    STEP_SUSPECTED = "window_differs"
    REFUSED_ELSEWHERE = "window_refused_elsewhere"
    CLEAR = "monitor_clear"
    NO_OBJECTION = "monitor_no_objection"
    SUSPECTED = "monitor_suspects"
    MOUNT_MOVED = "monitor_confirms"
    AT_ODDS = "monitor_at_odds"
    DATA_CAUSE = "data_cause"
    NOT_ACQUITTED = "not_acquitted"
    OVERDUE = "check_overdue"
    AGED = "aged"
    REPLACED = "replaced"
    TIME_STEPPED_BACK = "time_stepped_back"
    RESTARTED = "restarted"


MEANING: Mapping[HealthEvent, str] = MappingProxyType(
    {
        HealthEvent.CONFIRMED_BY_WINDOW: "an accepted window is served, or agrees with what is served",
        HealthEvent.CONFIRMED_EARLIER: "an accepted window is served, or agrees, but its data are older than three periods",
        HealthEvent.CONTRADICTED: "an accepted window contradicts what is served, and may not be applied",
        HealthEvent.STEP_SUSPECTED: "an accepted window differs from the windows before it; the next one decides",
        HealthEvent.REFUSED_ELSEWHERE: "a window was refused, but it, or its end, shows a pose other than what is served",
        HealthEvent.CLEAR: "a check acquits an extrinsic that a window has confirmed",
        HealthEvent.NO_OBJECTION: "a check acquits an extrinsic that no window has confirmed",
        HealthEvent.SUSPECTED: "the monitor suspects that the mount has moved, or checks accuse it and none acquits it "
        "for three periods",
        HealthEvent.MOUNT_MOVED: "the monitor is certain that the mount has moved",
        HealthEvent.AT_ODDS: "checks accuse the mount, but do not add up to a move",
        HealthEvent.DATA_CAUSE: "the data cannot be judged: lens, light, LiDAR, ego-motion, time",
        HealthEvent.NOT_ACQUITTED: "three periods passed in which checks were completed, and none acquits the extrinsic",
        HealthEvent.OVERDUE: "no check has been completed for three periods of the monitor",
        HealthEvent.AGED: "no check has been completed for `stale_after_s`",
        HealthEvent.REPLACED: "a person replaced the extrinsic (apply, rollback, reset)",
        HealthEvent.TIME_STEPPED_BACK: "the clock of the sensors stepped back: nothing has been checked in the new time",
        HealthEvent.RESTARTED: "the service was started again: nothing has been checked since",
    }
)

_U, _H, _S, _M, _D, _A = HealthState

# Rows: what happens. Columns: the state in which it happens, in the order of `HealthState`.
#   Green (healthy) is reached and renewed only by a check that acquits (CLEAR) or a window that agrees
#   (CONFIRMED_BY_WINDOW), and ends after three periods without one. Red (miscalibrated) ends only by
#   a window that agrees, by a person, or step by step by a monitor that stays clear; neither silence nor bad data hides
#   it. A window that cannot tell or failed is no event, because it says nothing of the mount.
_ROWS: Mapping[HealthEvent, tuple[HealthState, ...]] = {
    #                            unknown healthy suspect miscal. degraded stale
    HealthEvent.CONFIRMED_BY_WINDOW: (_H, _H, _H, _H, _H, _H),
    HealthEvent.CONFIRMED_EARLIER: (_U, _U, _U, _U, _U, _U),
    HealthEvent.CONTRADICTED: (_M, _M, _M, _M, _M, _M),
    HealthEvent.STEP_SUSPECTED: (_S, _S, _S, _M, _S, _S),
    HealthEvent.REFUSED_ELSEWHERE: (_S, _S, _S, _M, _S, _S),
    HealthEvent.CLEAR: (_H, _H, _H, _S, _H, _H),
    HealthEvent.NO_OBJECTION: (_U, _H, _S, _S, _U, _U),
    HealthEvent.SUSPECTED: (_S, _S, _S, _M, _S, _S),
    HealthEvent.MOUNT_MOVED: (_M, _M, _M, _M, _M, _M),
    HealthEvent.AT_ODDS: (_D, _D, _S, _M, _D, _D),
    HealthEvent.DATA_CAUSE: (_D, _D, _D, _M, _D, _D),
    HealthEvent.NOT_ACQUITTED: (_D, _D, _S, _M, _D, _D),
    HealthEvent.OVERDUE: (_U, _D, _S, _M, _D, _A),
    HealthEvent.AGED: (_U, _A, _A, _M, _A, _A),
    HealthEvent.REPLACED: (_U, _U, _U, _U, _U, _U),
    HealthEvent.TIME_STEPPED_BACK: (_U, _U, _S, _M, _U, _U),
    HealthEvent.RESTARTED: (_U, _U, _S, _M, _U, _U),
}

TRANSITIONS: Mapping[tuple[HealthState, HealthEvent], HealthState] = MappingProxyType(
    {(before, event): after for event, row in _ROWS.items() for before, after in zip(HealthState, row, strict=True)}
)
"""The state after an event, for every state and every event."""


def markdown() -> str:
    """The table for the documentation: a line per event, a column per state; · means that nothing changes."""
    rows = [["", *(state.value for state in HealthState)]]
    for event in HealthEvent:
        after = [TRANSITIONS[state, event] for state in HealthState]
        marks = ["·" if new is old else new.value for old, new in zip(HealthState, after, strict=True)]
        rows.append([event.value, *marks])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    rows.insert(1, ["-" * width for width in widths])
    cells = ([text.ljust(width) for text, width in zip(row, widths, strict=True)] for row in rows)
    return "".join(f"| {' | '.join(row)} |\n" for row in cells)
