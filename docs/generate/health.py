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
        "Written by `python -m generate docs`; do not edit.\n\n"
        f"## States\n\n{states}\n"
        f"## Events\n\n{events}\n"
        "## What follows\n\n"
        "Rows: what happens. Columns: the state in which it happens. · means that nothing changes.\n\n"
        f"{markdown()}\n"
        "## What the monitor needs\n\n"
        "Evidence is the log-likelihood ratio of a mount that moved, at some past time and to some place, against one\n"
        "that has not moved (`evidence` of a check, nats). A check counts by the share of its pairs that are new,\n"
        f"between {hypotheses.LEAST_STEP:+g} and {hypotheses.MOST_STEP:+g}. One with faint edges may make a mount "
        "suspect, but confirms nothing.\n\n"
        "The threshold follows from how often a right mount may be accused. It is the logarithm of the number of\n"
        f"tests, {change_detector.QUESTIONS} at every check, that begin within "
        "`monitor.hours_between_false_suspicions` for `suspect`, and\n"
        "within `monitor.hours_between_false_alarms` for `miscalibrated`: "
        f"{_LEVELS.suspect:.1f} and {_LEVELS.confirmed:.1f} with a check\n"
        f"every {_DEFAULT.period_s:g} s, {_DEFAULT.hours_between_false_suspicions:g} h and "
        f"{_DEFAULT.hours_between_false_alarms:g} h. A mount is clear again below {_LEVELS.clear:.1f}; evidence never "
        f"exceeds {_LEVELS.most:.1f}.\n\n"
        f"From {change_detector.AT_ODDS_AT:g} flagged checks in a row (one with faint edges counts "
        f"{change_detector.WEAK_SHARE:g}) that do not add up to a move, because\n"
        "they put the mount elsewhere every time, the monitor is at odds with itself. It is also at odds if no\n"
        "window has confirmed the served extrinsic yet and all checks together put the mount farther from it than\n"
        f"the estimator is on other rigs (squared distance above {change_detector.ASTRAY2:.1f}).\n\n"
        f"A cause in the data is believed from an evidence of {change_detector.BLIND_AT:g} checks on. Dirt is believed "
        "after the same blocks of\n"
        f"the image have shown no contrast for {sensor_faults.DIRTY_CHECKS:g} checks. Once its data could not be "
        "judged, a pair stays `degraded`\n"
        f"for {SETTLING_NS / 1e9:g} s of sensor time (`settling`), so that several poor stretches in a row count as "
        "one.\n\n"
        f"## Causes\n\n{told}"
    )


def _state_of(cause: Cause) -> HealthState:
    return HealthState.MISCALIBRATED if cause is BENT_MOUNT else HealthState.DEGRADED
