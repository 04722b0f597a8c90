"""The daemon under the load of a vehicle: processor time and memory of its I/O process, and how soon it answers while
its worker solves. Processes are real: the daemon (which is also the router), the sensors, and this one, which asks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from coec.adapters.files.rig import intrinsics_config
from coec.adapters.zenoh.client import ask_one, connected
from coec.config import (
    BudgetConfig,
    CalibrationConfig,
    Config,
    LogConfig,
    PairConfig,
    SearchConfig,
    StateConfig,
    WindowConfig,
    ZenohConfig,
)
from coec.schemas.keys import Keys
from coec_lab.bench import daemons, load, scene
from coec_lab.bench.process import ProcessReading

VEHICLE, PAIR = "bench", "0-0"
KEYS = Keys("coec", VEHICLE)
SETTLE_S, SECONDS = 10.0, 25.0
"""Time under load before anything counts, and length of each of the two measurements."""

SLICE_S = 20.0
"""A window of 25 pairs in so much time, nine times the default rate, so that the recorder works all the time."""

ENOUGH_CORES = 64.0
"""Budget, because windows come nine times as often as the default budget is meant for."""

QUERY_PERIOD_S, COMMAND_PERIOD_S = 0.05, 0.5
BUSY_SHARE = 0.5
"""The worker counts as solving if it used more than this share of a query period as processor time."""


@dataclass(slots=True)
class Seen:
    """Round trips of queries in ms, while the worker was solving and while it waited."""

    solving_ms: list[float] = field(default_factory=list)
    waiting_ms: list[float] = field(default_factory=list)


def measure(folder: Path, heard: Callable[[str], None]) -> dict[str, Any]:
    """Runs the daemon in `folder` under load, with native frames and with topics of ROS.

    Raises:
        ConnectionFailedError: the daemon did not become ready.
    """
    return native(folder, heard) | ros(folder, heard)


def native(folder: Path, heard: Callable[[str], None]) -> dict[str, Any]:
    """Figures with native frames, first at their rate alone, then also with one solve after another."""
    with _settled(folder, "native", WindowConfig(slice_s=SLICE_S), heard) as (session, process):
        document = _resources(session, process, heard)
        heard("the daemon under load: queries during solves")
        return document | _round_trips(session, process)


def ros(folder: Path, heard: Callable[[str], None]) -> dict[str, Any]:
    """Figures with the same sensors as nodes of ROS, and windows of the default length."""
    with _settled(folder, "ros", WindowConfig(), heard) as (session, process):
        return {f"ros_{name}": figure for name, figure in _resources(session, process, heard).items()}


@contextmanager
def _settled(
    folder: Path, form: str, window: WindowConfig, heard: Callable[[str], None]
) -> Iterator[tuple[zenoh.Session, ProcessReading]]:
    """A daemon that has been under load for a while, with a budget that does not limit its worker."""
    with loaded(folder, form, (window, BudgetConfig(cores=ENOUGH_CORES)), heard) as (session, process):
        _ask(session, KEYS, process, SETTLE_S, at_work=False)
        yield session, process


@contextmanager
def loaded(
    folder: Path, form: str, stages: tuple[WindowConfig, BudgetConfig], heard: Callable[[str], None], pace: float = 1.0
) -> Iterator[tuple[zenoh.Session, ProcessReading]]:
    """A daemon under the load `form` of `load.LOADS`, at `pace` seconds of driving in a second, with a session: frames
    of every sensor arrive.

    Raises:
        ConnectionFailedError: the daemon did not become ready, or a sensor sends nothing.
    """
    heard(f"the daemon starts, {form}")
    endpoint = f"tcp/127.0.0.1:{daemons.free_port()}"
    written = folder / f"{form}.yaml"
    # JSON is YAML.
    config = _configuration(endpoint, folder / form, form, *stages)
    written.write_text(config.model_dump_json(exclude_none=True))
    with (
        daemons.running("-m", "coec", "run", "--config", str(written)) as daemon,
        connected([endpoint], daemons.TIMEOUT_S) as session,
        daemons.running("-c", daemons.SENSORS, endpoint, form, str(pace)),
    ):
        heard(f"the daemon under load, {form}")
        daemons.await_running(session, KEYS)
        daemons.await_frames(session, KEYS)
        yield session, ProcessReading(daemon.pid)


def _resources(session: zenoh.Session, process: ProcessReading, heard: Callable[[str], None]) -> dict[str, Any]:
    """Processor and memory of the I/O process, and what arrived in the meantime."""
    heard("the daemon under load: processor and memory")
    process.reset_peak()
    cpu_s, begin_s = process.cpu_s, time.monotonic()
    before = _counters(session, KEYS)
    _ask(session, KEYS, process, SECONDS, at_work=False)
    elapsed_s = time.monotonic() - begin_s
    after = _counters(session, KEYS)
    return {
        "io_cpu_percent": 100.0 * (process.cpu_s - cpu_s) / elapsed_s,
        "io_resident_mb": process.peak_mb,
        "io_proportional_mb": process.proportional_mb,
        "io_per_second": {name: (after[name] - before[name]) / elapsed_s for name in after},
    }


def _round_trips(session: zenoh.Session, process: ProcessReading) -> dict[str, Any]:
    """Round trips of queries, while the worker solves and while it waits."""
    seen = _ask(session, KEYS, process, SECONDS, at_work=True)
    document: dict[str, Any] = {"query_during_solve_count": len(seen.solving_ms)}
    for name, times_ms in (("during_solve", seen.solving_ms), ("idle", seen.waiting_ms)):
        for percent in (50, 99):
            document[f"query_{name}_p{percent}_ms"] = float(np.percentile(times_ms, percent)) if times_ms else None
    return document


def _ask(session: zenoh.Session, keys: Keys, process: ProcessReading, seconds: float, *, at_work: bool) -> Seen:
    """Asks for the extrinsic all the time and, to keep the worker `at_work`, for another solve as soon as it waits."""
    seen = Seen()
    worker = ProcessReading(process.children[0])
    end_s = time.monotonic() + seconds
    next_command_s = 0.0
    while (now_s := time.monotonic()) < end_s:
        worker_s = worker.cpu_s
        begin_s = time.perf_counter()
        ask_one(session, keys.extrinsic(PAIR), daemons.TIMEOUT_S)
        elapsed_s = time.perf_counter() - begin_s
        # The pace of the queries is part of what is measured.
        time.sleep(max(QUERY_PERIOD_S - (time.monotonic() - now_s), 0.0))
        busy = worker.cpu_s - worker_s >= BUSY_SHARE * QUERY_PERIOD_S
        (seen.solving_ms if busy else seen.waiting_ms).append(1e3 * elapsed_s)
        if at_work and not busy and now_s >= next_command_s:
            session.get(keys.command(PAIR, "calibrate"))  # it does not matter if there is no window to solve
            next_command_s = now_s + COMMAND_PERIOD_S
    return seen


def _counters(session: zenoh.Session, keys: Keys) -> dict[str, int]:
    """Frames that came and what they became, since the start; a stream that several pairs share counts once."""
    pairs = daemons.status(session, keys)["pairs"]
    streams = {
        f"{kind}s": sum({pair["name"].split("-")[index]: pair[kind]["accepted"] for pair in pairs}.values())
        for index, kind in ((0, "camera"), (-1, "lidar"))
    }
    counted = {name: sum(pair[name] for pair in pairs) for name in ("pairs", "windows", "solved", "checks")}
    lost = sum(sum(pair["losses"].values()) for pair in pairs)
    return {**streams, **counted, "lost": lost}


def _configuration(endpoint: str, state: Path, form: str, window: WindowConfig, budget: BudgetConfig) -> Config:
    """Every camera paired with every LiDAR, as if all were at one place; the results do not matter."""
    what = load.LOADS[form]
    stages = {"window": window, "calibration": CalibrationConfig(search=SearchConfig(dof=6))}
    intrinsics = intrinsics_config(what.camera)
    pairs = []
    for name in what.pairs:
        camera, lidar = map(int, name.split("-"))
        document = {
            "name": name,
            "camera": _place(what, "camera", camera) | {"intrinsics": intrinsics},
            "lidar": _place(what, "lidar", lidar),
            "ego": _place(what, "ego", 0),
            "T_camera_lidar": scene.T_TRUE.tolist(),
            **stages,
        }
        pairs.append(PairConfig.model_validate(document))
    return Config(
        budget=budget,
        vehicle=VEHICLE,
        zenoh=ZenohConfig(embedded_router=True, listen=(endpoint,), connect=()),
        middleware="rmw_zenoh" if what.is_ros else "native",
        state=StateConfig(directory=state, min_free_bytes=0),
        log=LogConfig(level="error"),
        pairs=tuple(pairs),
    )


def _place(what: load.Load, kind: str, index: int) -> dict[str, str]:
    return {"topic": load.TOPICS[kind]} if what.is_ros else {"key": load.key(kind, index)}
