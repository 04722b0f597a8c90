"""The pages on a running service: health; figures of self-diagnosis; metrics; exit codes, problems, what a reload
takes, and what an update and a downgrade preserve."""

from __future__ import annotations

from collections.abc import Sequence

from coec.calibration.figures import FIGURES
from coec.calibration.monitor import change_detector, sensor_faults, sequential_tests
from coec.calibration.monitor.sensor_faults import BENT_MOUNT, CAUSES, Cause
from coec.calibration.state import SETTLING_NS
from coec.calibration.state_machine import MEANING, STATES, HealthState, markdown
from coec.config import MonitorConfig
from coec.errors import EXIT_CODE_MEANINGS, MAY_BE_CURED, NOT_CURED_BY_RESTART, ExitCode
from coec.service.api.metrics import FAMILIES
from coec.service.api.problems import PROBLEMS
from coec.service.configuration import RELOADED
from coec.service.timing import LONG_S, QUICK_S
from generate.markdown import WRITTEN, code, prose, table

METRICS = """\
# Metrics

{written}
OpenMetrics text, answered to a query for `<prefix>/@v1/<vehicle>/metrics` (`coec query metrics`). Counters have the
suffix `_total`, histograms `_bucket`, `_count` and `_sum`. The buckets end at {quick} s, those of the worker at
{long} s.

The same over HTTP, to GET and HEAD, where `metrics.http` names an address of loopback:

| page | answer |
|---|---|
| `/metrics` | OpenMetrics 1.0.0 if `Accept` names `application/openmetrics-text` and does not prefer `text/plain`, \
else the text format 0.0.4 of Prometheus |
| `/health` | 200 while the service runs and every pair may be used (ROS level OK or WARN), else 503 |
| `/live` | 200 while the service makes progress, else 503: then a restart helps. The page for liveness probes |

{table}"""

OPERATIONS = """\
# Operations

{written}
## Exit codes

Container engines start a service again whatever its exit code (`restart: unless-stopped`), after pauses that grow to a
minute. Code 78 ends alike each time: see to the log.

{codes}
## What may ail the service

Reasons in `health` and `status`, beside those of the calibration itself ([health](health.md)).

{troubles}
## What a reload takes

`systemctl reload coec` (SIGHUP) reads the configuration again. A file that could not be started with is refused as a
whole and changes nothing. These values hold from then on; all others wait for a restart. `coec query status` tells
under `configuration` which were taken, which wait, or why the file was refused. The history of each pair whose values
changed has an entry with the hashes before and after, and windows carry theirs (`settings_hash`).

{reloaded}
## What an update and a step back keep

Stop the service, replace the software, start it. Nothing in `state.directory` has to be converted: each version reads
what the others wrote, part by part. A part that it cannot read starts anew, and nothing else does. `health` then gives
the reason `state_other_version` with the parts and what follows, the loss counters `state_older` and `state_newer` of
`storage` count them, the history has an entry, and the file is kept aside as `state.json.older` or `.newer`.

{kept}
What an update or a step back loses never makes a pair `healthy`: it is `unknown` until it is checked again. A pair that
was `suspect` or `miscalibrated` stays so; if the evidence for that is lost, only a window that agrees with the
calibration, or a person, ends it. Keep a copy of `state.directory` before a step back over several versions.
"""

PRESERVED = (
    (
        "calibration, its provenance and uncertainty; candidate; `hold`; alarm counts (`state.json`)",
        "kept; of states before 22 November 2026, 10:56 UTC, without the uncertainty",
        "kept, to versions since 22 November 2026, 10:56 UTC; who holds since when and why: since 23 November",
    ),
    (
        "evidence of the monitor (`state.json`)",
        "kept since 26 November 2026, 16:30 UTC; earlier evidence starts anew, but what it accused stays accused",
        "kept",
    ),
    (
        "history (`*.jsonl`)",
        "kept and verified; an entry that cannot be read stays in its place",
        "kept; to versions before this one, an entry that they cannot read is damage (`history_damaged`)",
    ),
    (
        "baselines (`rig.json`)",
        "kept; not used if figures, network or settings have changed since (`baseline_mismatch`)",
        "kept, to versions since 23 November 2026, 02:49 UTC",
    ),
    ("poses of the rig, a move that is not over (`sensors.json`)", "kept", "kept"),
    (
        "nominal calibrations found on the bus (`nominal.json`)",
        "kept",
        "kept; to versions before this one, found again if the newer configuration had other keys",
    ),
    (
        "windows, snippets, evidence of incidents, log of checks",
        "kept; a check that cannot be read is left out",
        "kept likewise; windows of an incident that cannot be read stay protected from this version on",
    ),
    (
        "configuration",
        "kept",
        "take out keys that the earlier version does not know: it refuses the file (exit code 78)",
    ),
)
"""What is in the state directory; what an update keeps of it; what a step back keeps of it."""

FIGURES_HEAD = """\
# Figures

{written}
Every figure of self-diagnosis, of calibrations and of checks: what it tells, what it means where it does not keep its
limit, and what to do then. How limits come about: [the verdict](verdict.md), [the change detector](change.md).

{table}"""

_DEFAULT = MonitorConfig()
_LEVELS = change_detector.alarm_levels(_DEFAULT)


def metrics_page() -> str:
    """Markdown: every metric family."""
    heads = ("family", "type", "unit", "labels", "what it tells")
    rows = [
        (f"`{one.name}`", one.kind, one.unit, ", ".join(f"`{label}`" for label in one.labels), one.help)
        for one in FAMILIES
    ]
    return METRICS.format(written=WRITTEN, quick=_seconds(QUICK_S), long=_seconds(LONG_S), table=table(heads, rows))


def operations_page() -> str:
    """Markdown: exit codes, troubles, values that are reloaded, what an update keeps."""
    return OPERATIONS.format(
        written=WRITTEN,
        codes=table(
            ("code", "meaning", "systemd starts `run` again"),
            [(str(status.value), text, _is_restarted(status)) for status, text in EXIT_CODE_MEANINGS.items()],
        ),
        troubles=table(
            ("code", "meaning", "what to do"),
            [(f"`{name}`", problem.meaning, problem.advice) for name, problem in PROBLEMS.items()],
        ),
        reloaded=table(("value", "holds"), [(f"`{place}`", when) for place, when in RELOADED.items()]),
        kept=table(("what", "an update", "a step back"), PRESERVED),
    )


def _is_restarted(status: ExitCode) -> str:
    """Whether systemd starts the service again after this exit status, in a word."""
    return "no" if status in NOT_CURED_BY_RESTART else "yes" if status in MAY_BE_CURED else ""


def _seconds(bounds_s: Sequence[float]) -> str:
    return ", ".join(f"{bound_s:g}" for bound_s in bounds_s)


def figures_page() -> str:
    """Markdown: every figure."""
    heads = ("figure", "name, unit", "what it tells", "beyond its limit", "what to do")
    rows = [
        (
            code(name),
            f"{one.title}, {one.unit}" if one.unit else one.title,
            prose(one.measures),
            prose(one.fails),
            prose(one.advice),
        )
        for name, one in FIGURES.items()
    ]
    return FIGURES_HEAD.format(written=WRITTEN, table=table(heads, rows))


def health_page() -> str:
    """Markdown: states, events, the table of transitions, what the monitor needs, causes in the data."""
    states = "".join(f"- `{state.value}`: {STATES[state]}\n" for state in HealthState)
    events = "".join(f"- `{event.value}`: {meaning}\n" for event, meaning in MEANING.items())
    causes = "".join(
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
        f"between {sequential_tests.LEAST_STEP:+g} and {sequential_tests.MOST_STEP:+g}. One with faint edges may "
        "make a mount suspect, but confirms nothing.\n\n"
        "The threshold follows from how often a right mount may be accused. It is the logarithm of the number of\n"
        f"tests, {change_detector.TESTS_PER_CHECK} at every check, that begin within "
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
        f"## Causes\n\n{causes}"
    )


def _state_of(cause: Cause) -> HealthState:
    return HealthState.MISCALIBRATED if cause is BENT_MOUNT else HealthState.DEGRADED
