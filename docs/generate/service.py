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

Container engines restart a service after any exit code (`restart: unless-stopped`), with pauses that grow to a minute.
Code 78 repeats until the cause is removed: check the log.

{codes}
## Service problems

Reasons in `health` and `status`, in addition to those of the calibration ([health](health.md)).

{troubles}
## Reload

`systemctl reload coec` (SIGHUP) reads the configuration again. An invalid file is refused completely and changes
nothing. The values below take effect; all others wait for a restart. `coec query status` shows under `configuration`
which values were applied, which wait, or why the file was refused. The history of each pair whose values changed has an
entry with the hashes before and after, and windows contain theirs (`settings_hash`).

{reloaded}
## Updates and downgrades

Stop the service, replace the software, start it. Nothing in `state.directory` has to be converted: each version reads
what the others wrote, part by part. Only a part that it cannot read is reset. `health` then gives the reason
`state_other_version` with the parts and the consequences, the loss counters `state_older` and `state_newer` of
`storage` count them, the history has an entry, and the file is renamed to `state.json.older` or `.newer`.

{kept}
State that an update or a downgrade loses never makes a pair `healthy`: it is `unknown` until it is checked again. A
pair that was `suspect` or `miscalibrated` stays so. If the evidence for that is lost, only a window that agrees with
the calibration, or a command, ends it. Copy `state.directory` before a downgrade over several versions.
"""

PRESERVED = (
    (
        "calibration, its provenance and uncertainty; candidate; `hold`; alarm counts (`state.json`)",
        "preserved; of states before 22 November 2026, 10:56 UTC, without the uncertainty",
        "preserved, to versions since 22 November 2026, 10:56 UTC; sender, time, reason of `hold`: since 23 November",
    ),
    (
        "evidence of the monitor (`state.json`)",
        "preserved since 26 November 2026, 16:30 UTC; earlier evidence is reset, but the states that it led to stay",
        "preserved",
    ),
    (
        "history (`*.jsonl`)",
        "preserved and verified; an entry that cannot be read stays in its place",
        "preserved; versions before this one report an entry that they cannot read as `history_damaged`",
    ),
    (
        "baselines (`rig.json`)",
        "preserved; not used if figures, network or settings have changed since (`baseline_mismatch`)",
        "preserved, to versions since 23 November 2026, 02:49 UTC",
    ),
    ("poses of the rig, an unresolved move (`sensors.json`)", "preserved", "preserved"),
    (
        "nominal calibrations discovered on the bus (`nominal.json`)",
        "preserved",
        "preserved; versions before this one discover them again if the newer configuration had other keys",
    ),
    (
        "windows, snippets, evidence of incidents, log of checks",
        "preserved; a check that cannot be read is omitted",
        "preserved likewise; windows of an incident that cannot be read stay protected from this version on",
    ),
    (
        "configuration",
        "preserved",
        "remove keys that the earlier version does not know: it refuses the file (exit code 78)",
    ),
)
"""Content of the state directory; what an update preserves; what a downgrade preserves."""

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
        kept=table(("what", "update", "downgrade"), PRESERVED),
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
        f"- `{cause.code}` (`{_state_of(cause).value}`): {cause.text} {cause.advice}\n"
        for cause in (BENT_MOUNT, *(cause for cause in CAUSES.values() if cause is not BENT_MOUNT))
    )
    return (
        "# Health\n\n"
        "Written by `python -m generate docs`; do not edit.\n\n"
        f"## States\n\n{states}\n"
        f"## Events\n\n{events}\n"
        "## Transitions\n\n"
        "Rows: events. Columns: the state before the event. · means no change.\n\n"
        f"{markdown()}\n"
        "## Thresholds of the monitor\n\n"
        "The evidence (`evidence` of a check, nats) is the log-likelihood ratio of a mount that moved, at some past\n"
        "time by some displacement, against one that has not moved. The weight of a check is the share of its frame\n"
        "pairs that are new; its contribution is limited to "
        f"{sequential_tests.LEAST_STEP:+g}…{sequential_tests.MOST_STEP:+g}. A check with faint edges can make a mount\n"
        "suspect, but confirms no move.\n\n"
        "The threshold follows from the false-alarm rate. It is the logarithm of the number of tests that begin\n"
        "within `monitor.hours_between_false_suspicions` for `suspect`, and within\n"
        "`monitor.hours_between_false_alarms` for `miscalibrated`. "
        f"{change_detector.TESTS_PER_CHECK} tests begin at every check. With a check\n"
        f"every {_DEFAULT.period_s:g} s, {_DEFAULT.hours_between_false_suspicions:g} h and "
        f"{_DEFAULT.hours_between_false_alarms:g} h the thresholds are "
        f"{_LEVELS.suspect:.1f} and {_LEVELS.confirmed:.1f}. A mount is clear again below\n"
        f"{_LEVELS.clear:.1f}; evidence is limited to {_LEVELS.most:.1f}.\n\n"
        "The event `monitor_at_odds` occurs in two cases:\n\n"
        f"- {change_detector.AT_ODDS_AT:g} or more flagged checks in a row (one with faint edges counts "
        f"{change_detector.WEAK_SHARE:g}) disagree about the pose.\n"
        "- No window has confirmed the served extrinsic yet, and the mean of all checks differs from it by more than\n"
        f"  the estimator does on other rigs (squared distance above {change_detector.ASTRAY2:.1f}).\n\n"
        f"A cause in the data is reported from an evidence of {change_detector.BLIND_AT:g} checks on. Dirt is reported "
        "after the same blocks of\n"
        f"the image have shown no contrast for {sensor_faults.DIRTY_CHECKS:g} checks. After a time without usable data "
        "a pair stays `degraded`\n"
        f"for {SETTLING_NS / 1e9:g} s of sensor time (`settling`), so that several poor stretches in a row count as "
        "one.\n\n"
        f"## Causes\n\n{causes}"
    )


def _state_of(cause: Cause) -> HealthState:
    return HealthState.MISCALIBRATED if cause is BENT_MOUNT else HealthState.DEGRADED
