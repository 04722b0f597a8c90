"""Health as an explicit state machine: six states (CONTRACT), the events, and one table of transitions; how long a
pair has been watched and how its alarms ended, so that false alarms are counted rather than estimated; and whether
an accepted estimate may become current without a person.

The table covers every state and event, and nothing else decides a change of state. `markdown()` renders it for the
documentation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from math import degrees, fsum
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4, Reason
from coec.config import PolicyConfig
from coec.geometry import se3


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
        HealthState.UNKNOWN: "the served extrinsic has not been checked",
        HealthState.HEALTHY: "the served extrinsic has been checked and agrees with the data",
        HealthState.SUSPECT: "there is evidence against the served extrinsic; a window is being recorded to decide",
        HealthState.MISCALIBRATED: "the served extrinsic is wrong",
        HealthState.DEGRADED: "the data or the service do not allow a judgement",
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
        HealthEvent.CONFIRMED_BY_WINDOW: "an accepted window is served, or agrees with the served extrinsic",
        HealthEvent.CONFIRMED_EARLIER: "an accepted window is served, or agrees, but its data are older than three "
        "periods",
        HealthEvent.CONTRADICTED: "an accepted window contradicts the served extrinsic, and may not be applied",
        HealthEvent.STEP_SUSPECTED: "an accepted window differs from the windows before it; the next one decides",
        HealthEvent.REFUSED_ELSEWHERE: "a window was refused, but its pose, or the pose at its end, is not the "
        "served one",
        HealthEvent.CLEAR: "a check validates an extrinsic that a window has confirmed",
        HealthEvent.NO_OBJECTION: "a check validates an extrinsic that no window has confirmed",
        HealthEvent.SUSPECTED: "the monitor suspects that the mount has moved, or checks that agree on a move "
        "contradict the extrinsic and none validates it for three periods",
        HealthEvent.MOUNT_MOVED: "the monitor confirms that the mount has moved",
        HealthEvent.AT_ODDS: "checks contradict the extrinsic, but do not agree on a move",
        HealthEvent.DATA_CAUSE: "the data cannot be judged: lens, light, LiDAR, ego-motion, time",
        HealthEvent.NOT_ACQUITTED: "checks were completed for three periods, and none validates the extrinsic",
        HealthEvent.OVERDUE: "no check has been completed for three periods of the monitor",
        HealthEvent.AGED: "no check has been completed for `stale_after_s`",
        HealthEvent.REPLACED: "a command replaced the extrinsic (apply, rollback, reset)",
        HealthEvent.TIME_STEPPED_BACK: "the clock of the sensors stepped back: nothing has been checked in the new "
        "time",
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


GAP_NS = 60_000_000_000
"""Sensor time, ns. Between two completed checks that are farther apart the pair counts as not watched. It is twelve
default periods of the monitor, and longer than a stretched period."""


@dataclass(frozen=True, slots=True)
class AlarmRecord:
    """The record since the pair got its state directory.

    Attributes:
        watched_ns: sensor time between completed checks.
        confirmed: number of alarms (`miscalibrated`) that ended with another extrinsic.
        withdrawn: number of false alarms: they ended `healthy` with the extrinsic that they accused.
        accused: whether an alarm is going on.
    """

    watched_ns: int = 0
    confirmed: int = 0
    withdrawn: int = 0
    accused: bool = False

    def watched(self, from_ns: int | None, to_ns: int | None) -> AlarmRecord:
        """The record after a check was completed at `to_ns`, and the one before it at `from_ns` (sensor time); None if
        unknown."""
        if from_ns is None or to_ns is None or not 0 < to_ns - from_ns <= GAP_NS:
            return self
        return replace(self, watched_ns=self.watched_ns + to_ns - from_ns)

    def entered(self, health: HealthState, *, replaced: bool) -> AlarmRecord:
        """The record after the pair came to a state of health; `replaced`: whether its extrinsic was replaced on the
        way there."""
        miscalibrated = health is HealthState.MISCALIBRATED
        if self.accused and replaced:
            return replace(self, confirmed=self.confirmed + 1, accused=miscalibrated)
        if self.accused and health is HealthState.HEALTHY:
            return replace(self, withdrawn=self.withdrawn + 1, accused=False)
        return self if self.accused or not miscalibrated else replace(self, accused=True)


NS_PER_DAY = 86_400_000_000_000

AXES = ("pitch", "yaw", "roll", "x", "y", "z")


@dataclass(frozen=True, slots=True)
class AppliedChange:
    """A step of the served extrinsic that no person ordered: sensor time, and |rx ry rz tx ty tz| (rad, m)."""

    stamp_ns: int
    step: tuple[float, ...]


def step_between(T_before: Matrix4, T_after: Matrix4) -> NDArray[np.float64]:
    """(6,) perturbation about the camera axes from one extrinsic to the other (rad, m)."""
    return np.asarray(se3.difference(T_after, T_before), dtype=np.float64)


def objection(
    step: NDArray[np.float64], past: Iterable[AppliedChange], stamp_ns: int, policy: PolicyConfig
) -> Reason | None:
    """Why a step (6,) must wait for a person; None when it may be applied.

    Args:
        past: earlier steps; those within 24 h of sensor time of `stamp_ns` count towards the limits of a day.
    """
    if policy.apply == "always":
        return None
    if policy.apply == "never":
        return Reason("apply_never", "policy.apply is `never`: the candidate waits for `command/apply`.")
    size = [abs(float(value)) for value in step]
    recent = [change.step for change in past if abs(stamp_ns - change.stamp_ns) < NS_PER_DAY]
    for axis, name in enumerate(AXES):
        turns = axis < 3
        shown, unit = (degrees(size[axis]), "°") if turns else (size[axis], " m")
        limit = policy.max_step_deg if turns else policy.max_step_m
        if shown > limit:
            return Reason("step_too_large", f"The step in {name} is {shown:.3g}{unit}, policy allows {limit:g}{unit}.")
        day = fsum([size[axis], *(step[axis] for step in recent)])
        shown, limit = (degrees(day), policy.max_per_day_deg) if turns else (day, policy.max_per_day_m)
        if shown > limit:
            text = f"The steps of a day in {name} add up to {shown:.3g}{unit}, policy allows {limit:g}{unit}."
            return Reason("day_exhausted", text)
    return None


def remembered(past: Iterable[AppliedChange], stamp_ns: int) -> tuple[AppliedChange, ...]:
    """The changes that still count at `stamp_ns`."""
    return tuple(change for change in past if abs(stamp_ns - change.stamp_ns) < NS_PER_DAY)


def agrees(step: NDArray[np.float64], policy: PolicyConfig) -> bool:
    """Whether a step (6,) is too small to speak of a contradiction."""
    size = [abs(float(value)) for value in step]
    return max(map(degrees, size[:3])) <= policy.agree_deg and max(size[3:]) <= policy.agree_m
