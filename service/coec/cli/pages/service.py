"""The pages on a running service: its metrics; its exit codes, its troubles, and what a reload takes."""

from __future__ import annotations

from collections.abc import Sequence

from coec.cli.exit_codes import EXIT_CODES
from coec.cli.pages.markdown import WRITTEN, table
from coec.runtime.api.metrics import FAMILIES
from coec.runtime.api.troubles import TROUBLES
from coec.runtime.reload import RELOADED
from coec.runtime.timings import LONG_S, QUICK_S

METRICS = """\
# Metrics

{written}
OpenMetrics text, answered to a query for `<prefix>/@v1/<vehicle>/metrics` (`coec query metrics`), and over HTTP at
`/metrics` where `metrics.http` names an address of loopback. `/health` there is 200 while the service runs and every
pair may be used (ROS level OK or WARN), else 503. Counters have the suffix `_total`, histograms `_bucket`, `_count`
and `_sum`; their buckets end at {quick} s,
those of the worker at {long} s.

{table}"""

OPERATIONS = """\
# Operations

{written}
## Exit codes

{codes}
## What may ail the service

Reasons in `health` and `status`, beside those of the calibration itself ([health](health.md)).

{troubles}
## What a reload takes

`systemctl reload coec` (SIGHUP) reads the configuration again. A file that could not be started with is refused as a
whole and changes nothing. These values hold from then on; all others wait for a restart. `coec query status` tells
under `configuration` which were taken, which wait, or why the file was refused. The history of each pair whose values
changed has an entry with the hashes before and after, and windows carry theirs (`settings_hash`).

{reloaded}"""


def metrics_page() -> str:
    """Markdown: every metric family."""
    heads = ("family", "type", "unit", "labels", "what it tells")
    rows = [
        (f"`{one.name}`", one.kind, one.unit, ", ".join(f"`{label}`" for label in one.labels), one.help)
        for one in FAMILIES
    ]
    return METRICS.format(written=WRITTEN, quick=_seconds(QUICK_S), long=_seconds(LONG_S), table=table(heads, rows))


def operations_page() -> str:
    """Markdown: exit codes, troubles, values that are reloaded."""
    return OPERATIONS.format(
        written=WRITTEN,
        codes=table(("code", "meaning"), [(str(code), meaning) for code, meaning in EXIT_CODES.items()]),
        troubles=table(
            ("code", "meaning", "what to do"),
            [(f"`{code}`", trouble.meaning, trouble.advice) for code, trouble in TROUBLES.items()],
        ),
        reloaded=table(("value", "holds"), [(f"`{place}`", when) for place, when in RELOADED.items()]),
    )


def _seconds(bounds_s: Sequence[float]) -> str:
    return ", ".join(f"{bound_s:g}" for bound_s in bounds_s)
