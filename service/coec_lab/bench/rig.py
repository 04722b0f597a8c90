"""The daemon with the cameras of a whole vehicle: four fisheyes and one LiDAR, as four pairs; and eight cameras with
three LiDARs, as twenty-four. Measures the load of its processes, and how long a pair goes without a look.

Rates are those of a vehicle, and the configuration is the default: a check of each pair every five seconds, and a
window of each every three minutes, as far as the budget allows. Processes are real, as in `live`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from coec.config import BudgetConfig, WindowConfig
from coec.runtime.worker import jobs
from coec_lab.bench import daemons, live, load
from coec_lab.bench.process import ProcessReading

KEYS = live.KEYS

SETTLE_S = 20.0
"""Time under load before anything counts: it has the first checks, for which the worker is not warm yet."""

SECONDS = {"rig": WindowConfig().slice_s, "large_rig": 60.0}
"""Time that counts, by load. It holds one window of each pair of the rig. In the large rig many pairs wait for the
budget, and a minute shows how long."""

LOOK_S = 1.0
"""Driving time between two readings of the age of each pair's latest check."""

KINDS = (jobs.Kind.CHECK.value, jobs.Kind.SOLVE.value, jobs.PREFETCH)
"""Kinds of work that the worker does for the streams."""

PACE = 1.0
"""Seconds of driving in a second. All figures are per second of driving, so that a machine that is busy with something
else can be measured at a slower pace."""


def measure(folder: Path, heard: Callable[[str], None]) -> dict[str, Any]:
    """Runs the daemon in `folder` under each load that `SECONDS` names, one after the other.

    Raises:
        ConnectionFailedError: the daemon did not become ready.
    """
    document: dict[str, Any] = {}
    for form in SECONDS:
        with live.loaded(folder, form, (WindowConfig(), BudgetConfig()), heard, PACE) as (session, process):
            time.sleep(SETTLE_S / PACE)
            figures = _figures(session, process, form, heard)
            document |= {f"{form}_{name}": figure for name, figure in figures.items()}
    return document


def _figures(
    session: zenoh.Session, service: ProcessReading, form: str, heard: Callable[[str], None]
) -> dict[str, Any]:
    pairs, seconds = load.LOADS[form].pairs, SECONDS[form]
    worker = ProcessReading(service.children[0])
    before, begin_s = daemons.status(session, KEYS), time.monotonic()
    for process in (service, worker):
        process.reset_peak()
    service_s, worker_s = service.cpu_s, worker.cpu_s
    unseen_s = dict.fromkeys(pairs, 0.0)
    while time.monotonic() < begin_s + seconds / PACE:
        time.sleep(LOOK_S / PACE)
        driven_s = PACE * (time.monotonic() - begin_s)
        heard(f"the daemon under load, {form}: {driven_s:.0f} of {seconds:.0f} s of driving")
        for name in pairs:
            age_s = daemons.answered(session, KEYS.health(name))["age_s"]
            elapsed_s = time.monotonic() - begin_s
            unseen_s[name] = max(unseen_s[name], PACE * (elapsed_s if age_s is None else age_s))
    elapsed_s = PACE * (time.monotonic() - begin_s)
    io_percent = 100.0 * (service.cpu_s - service_s) / elapsed_s
    worker_percent = 100.0 * (worker.cpu_s - worker_s) / elapsed_s
    after = daemons.status(session, KEYS)
    losses = Counter[str]()
    for pair in after["pairs"]:
        losses.update(pair["losses"])
    return {
        "cpu_percent": io_percent + worker_percent,
        "io_cpu_percent": io_percent,
        "worker_cpu_percent": worker_percent,
        "worker_s": {kind: 60.0 * (_spent_s(after, kind) - _spent_s(before, kind)) / elapsed_s for kind in KINDS},
        "unseen_s": max(unseen_s.values()),
        "done": {name: _done(after, name) - _done(before, name) for name in ("checks", "solved")},
        "resident_mb": service.peak_mb,
        "worker_resident_mb": worker.peak_mb,
        "wanted_cores": after["budget"]["wanted"],
        "stretched_by": after["budget"]["stretched_by"],
        "losses": dict(losses),
        "health": Counter(daemons.answered(session, KEYS.health(name))["state"] for name in pairs),
    }


def _spent_s(status: dict[str, Any], kind: str) -> float:
    """Time that the worker has spent on a kind of work, s."""
    taken_s: float = status["budget"]["spent_s"].get(kind, 0.0)
    return taken_s


def _done(status: dict[str, Any], what: str) -> int:
    return sum(pair[what] for pair in status["pairs"])
