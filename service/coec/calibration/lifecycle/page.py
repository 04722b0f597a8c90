"""The page of the documentation about health, made from the tables that the code runs on."""

from __future__ import annotations

from coec.calibration.lifecycle.pair_state import SETTLING_NS
from coec.calibration.lifecycle.states import MEANING, STATES, HealthState, markdown
from coec.calibration.monitor import change_detector, hypotheses, sensor_faults
from coec.calibration.monitor.sensor_faults import BENT_MOUNT, CAUSES, Cause
from coec.config import MonitorConfig

_DEFAULT = MonitorConfig()
_LEVELS = change_detector.alarm_levels(_DEFAULT)


def page() -> str:
    """Markdown: states, events, the table of transitions, what the monitor needs, causes in the data."""
    states = "".join(f"- `{state.value}`: {STATES[state]}\n" for state in HealthState)
    events = "".join(f"- `{event.value}`: {meaning}\n" for event, meaning in MEANING.items())
    told = "".join(
        f"- `{cause.code}`: {cause.text} Then `{_state_of(cause).value}`. {cause.advice}\n"
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
        "Evidence is the log-likelihood ratio of a mount that has moved, some time ago and somewhere, against one\n"
        "that has not (`evidence` of a check, nats). Every check counts by the share of its pairs that are new,\n"
        f"between {hypotheses.LEAST_STEP:+g} and {hypotheses.MOST_STEP:+g}; one with faint edges may make a mount\n"
        "suspect and confirms nothing. How much it takes follows from how often a right mount may be accused:\n"
        f"the logarithm of the tests, {change_detector.QUESTIONS} at every check, that begin in\n"
        "`monitor.hours_between_false_suspicions` for `suspect`, in `monitor.hours_between_false_alarms` for\n"
        f"`miscalibrated`: {_LEVELS.suspect:.1f} and {_LEVELS.confirmed:.1f} with a check every\n"
        f"{_DEFAULT.period_s:g} s, {_DEFAULT.hours_between_false_suspicions:g} h and "
        f"{_DEFAULT.hours_between_false_alarms:g} h; clear again below {_LEVELS.clear:.1f}, never more than "
        f"{_LEVELS.most:.1f}.\n"
        f"From {change_detector.AT_ODDS_AT:g} flagged checks in a row on (one with faint edges is "
        f"{change_detector.WEAK_SHARE:g}) that do not\n"
        "add up to that, as they put the mount elsewhere every time, the monitor is at odds with itself. So it is\n"
        "where all checks together put a mount, for which no window has vouched yet, farther from what is served\n"
        f"than the estimator is on other rigs (squared distance above {change_detector.ASTRAY2:.1f}).\n"
        f"A cause in the data is believed from {change_detector.BLIND_AT:g} on; dirt is one after the same blocks\n"
        f"of the image have shown no contrast for {sensor_faults.DIRTY_CHECKS:g} checks.\n"
        f"Once its data could not be judged a pair stays `degraded` for {SETTLING_NS / 1e9:g} s of sensor time\n"
        "(`settling`): one poor stretch after another is one.\n\n"
        f"## Causes\n\n{told}"
    )


def _state_of(cause: Cause) -> HealthState:
    return HealthState.MISCALIBRATED if cause is BENT_MOUNT else HealthState.DEGRADED
