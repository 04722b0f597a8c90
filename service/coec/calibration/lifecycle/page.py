"""The page of the documentation about health, made of the tables that the code runs on."""

from __future__ import annotations

from coec.calibration.lifecycle.states import MEANING, STATES, HealthState, markdown
from coec.calibration.monitor import change_detector, sensor_faults
from coec.calibration.monitor.sensor_faults import BENT_MOUNT, CAUSES, Cause


def page() -> str:
    """Markdown: states, events, the table of transitions, what the monitor needs, causes in the data."""
    states = "".join(f"- `{state.value}`: {STATES[state]}\n" for state in HealthState)
    events = "".join(f"- `{event.value}`: {meaning}\n" for event, meaning in MEANING.items())
    told = "".join(
        f"- `{cause.code}`: {cause.text} Then `{_state_of(cause).value}`.\n"
        for cause in (BENT_MOUNT, *(cause for cause in CAUSES.values() if cause is not BENT_MOUNT))
    )
    return (
        "# Health\n\n"
        "Written by `python -m coec.calibration.lifecycle`; do not edit.\n\n"
        f"## States\n\n{states}\n"
        f"## Events\n\n{events}\n"
        "## What follows\n\n"
        "Rows: what happens. Columns: the state in which it happens. · means that nothing changes.\n\n"
        f"{markdown()}\n"
        "## What the monitor needs\n\n"
        "Checks add up: a flagged check of pairs that were not counted yet adds 1, a clear one takes 1 off, a flagged\n"
        f"one with faint edges adds {change_detector.WEAK_SHARE:g}.\n"
        f"`suspect` from {change_detector.SUSPECT_AT:g} on, `miscalibrated` from {change_detector.CONFIRMED_AT:g} on, "
        f"clear again below {change_detector.CLEAR_BELOW:g}; never more than {change_detector.MOST:g}.\n"
        f"Flagged checks that put the mount in different places do not add up: from {change_detector.AT_ODDS_AT:g} on\n"
        "the monitor is at odds with itself, and tells nothing.\n"
        f"A cause in the data is believed from {change_detector.BLIND_AT:g} on; dirt is one after the same blocks\n"
        f"of the image have shown no contrast for {sensor_faults.DIRTY_CHECKS:g} checks.\n\n"
        f"## Causes\n\n{told}"
    )


def _state_of(cause: Cause) -> HealthState:
    return HealthState.MISCALIBRATED if cause is BENT_MOUNT else HealthState.DEGRADED
