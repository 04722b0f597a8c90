"""The daemon with the cameras of a whole vehicle: four fisheyes and one LiDAR, as four pairs. What its processes take
of the machine, and how long a pair is not seen.

At the rates of a vehicle and with the defaults of the configuration: a check of each pair every five seconds, a window
of each every three minutes, and as long as a window is what is measured. Real processes, as in `live`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from coec.cli.bench import daemons, live, load
from coec.cli.bench.process import ProcessReading
from coec.config import BudgetConfig, WindowConfig
from coec.runtime.worker import jobs

KEYS = live.KEYS
PAIRS = tuple(f"{camera}-0" for camera in range(load.LOADS["rig"].cameras))

SETTLE_S = 20.0
"""Under load before anything counts: the first checks, whose pairs the worker has never seen the like of."""

SECONDS = WindowConfig().slice_s
"""Of the time that counts: each pair has one window in it."""

LOOK_S = 1.0
"""Of driving, between two looks at how old the latest check of each pair is."""

KINDS = (jobs.Kind.CHECK.value, jobs.Kind.SOLVE.value, jobs.PREFETCH)
"""What the worker does for the stream."""

PACE = 1.0
"""Seconds of driving in a second. Every figure is by the second of driving: a machine that is busy with something else
can be asked for the same at a slower pace."""


def measure(folder: Path, heard: Callable[[str], None]) -> dict[str, Any]:
    """Runs the daemon in `folder` under the load of the rig of `load.LOADS`.

    Raises:
        ConnectionFailedError: the daemon did not become ready.
    """
    with live.loaded(folder, "rig", (WindowConfig(), BudgetConfig()), heard, PACE) as (session, process):
        time.sleep(SETTLE_S / PACE)
        return _figures(session, process)


def _figures(session: zenoh.Session, service: ProcessReading) -> dict[str, Any]:
    worker = ProcessReading(service.children[0])
    before, begin_s = daemons.status(session, KEYS), time.monotonic()
    service_s, worker_s = service.cpu_s, worker.cpu_s
    unseen_s = dict.fromkeys(PAIRS, 0.0)
    while time.monotonic() < begin_s + SECONDS / PACE:
        time.sleep(LOOK_S / PACE)
        for name in PAIRS:
            age_s = daemons.answered(session, KEYS.health(name))["age_s"]
            elapsed_s = time.monotonic() - begin_s
            unseen_s[name] = max(unseen_s[name], PACE * (elapsed_s if age_s is None else age_s))
    elapsed_s = PACE * (time.monotonic() - begin_s)
    io_percent = 100.0 * (service.cpu_s - service_s) / elapsed_s
    worker_percent = 100.0 * (worker.cpu_s - worker_s) / elapsed_s
    after = daemons.status(session, KEYS)
    return {
        "rig_cpu_percent": io_percent + worker_percent,
        "rig_io_cpu_percent": io_percent,
        "rig_worker_cpu_percent": worker_percent,
        "rig_worker_s": {kind: 60.0 * (_spent_s(after, kind) - _spent_s(before, kind)) / elapsed_s for kind in KINDS},
        "rig_unseen_s": max(unseen_s.values()),
        "rig_done": {name: _done(after, name) - _done(before, name) for name in ("checks", "solved")},
        "rig_resident_mb": service.resident_mb,
        "rig_health": {name: daemons.answered(session, KEYS.health(name))["state"] for name in PAIRS},
    }


def _spent_s(status: dict[str, Any], kind: str) -> float:
    """What the worker has taken for work of a kind, s."""
    taken_s: float = status["budget"]["spent_s"].get(kind, 0.0)
    return taken_s


def _done(status: dict[str, Any], what: str) -> int:
    return sum(pair[what] for pair in status["pairs"])
