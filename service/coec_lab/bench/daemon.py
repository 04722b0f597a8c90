"""The daemon under the load of a vehicle: processor time and memory of its processes, how soon it answers while its
worker solves, and how long a pair stays unchecked.

Processes are real: the daemon (which is also the router), the sensors, and this one, which queries. Loads are one
camera with one LiDAR as native frames and as topics of ROS, and whole vehicles: four fisheyes with one LiDAR (four
pairs), and eight cameras with three LiDARs (twenty-four pairs) in the default configuration."""

import json
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

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
from coec.errors import ConnectionFailedError, NotFoundError
from coec.io.rig_files import intrinsics_config
from coec.io.zenoh.query_client import connected, query_one
from coec.schemas.keys import Keys
from coec.service.worker import worker_jobs
from coec.service.worker.child_process import PACKAGE_ROOT
from coec_lab.bench import scene, sensors
from coec_lab.bench.processes import ProcessReading

VEHICLE, PAIR = "bench", "0-0"
KEYS = Keys("coec", VEHICLE)

TIMEOUT_S = 60.0
"""Timeout of an answer, and of the end of a process."""

POLL_S, READY_S = 0.1, 300.0
"""Period of polling whether the daemon runs, because it cannot announce that; and the time limit, because a first start
compiles every kernel, for a minute and a half on two busy cores."""

FIRST_FRAME_S = 60.0
"""Time limit for the first frame of every sensor, once the daemon runs."""

SENSORS = ("-m", "coec_lab.bench.sensors")
"""Arguments of the Python process that sends frames; those of `sensors.main` follow."""

SLICE_S = 20.0
"""A window of 25 pairs in so much time, nine times the default rate, so that the recorder works all the time."""

ENOUGH_CORES = 64.0
"""Budget, because windows come nine times as often as the default budget is meant for."""

QUERY_PERIOD_S, COMMAND_PERIOD_S = 0.05, 0.5
BUSY_SHARE = 0.5
"""The worker counts as solving if it used more than this share of a query period as processor time."""

RIG_SECONDS: Mapping[str, float] = {"rig": WindowConfig().slice_s, "large_rig": 60.0}
"""Time that counts, by load of a whole vehicle. It holds one window of each pair of the rig. In the large rig many
pairs wait for the budget, and a minute shows how long."""

READING_S = 1.0
"""Driving time between two readings of the age of each pair's latest check."""

KINDS = (worker_jobs.Kind.CHECK.value, worker_jobs.Kind.SOLVE.value, worker_jobs.PREFETCH)
"""Kinds of work that the worker does for the streams."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How long the daemon is measured, seconds.

    Attributes:
        settle: under load before anything counts.
        measured: length of each measurement.
        first_frame: time limit for the first frame of every sensor, once the daemon runs.
    """

    settle: float = 10.0
    measured: float = 25.0
    first_frame: float = FIRST_FRAME_S


RIG_SETTLE_S = 20.0
"""Time under load of a whole vehicle before anything counts: it has the first checks, for which the worker is not warm
yet."""


@dataclass(slots=True)
class RoundTrips:
    """Round trips of queries in ms, while the worker was solving and while it waited."""

    solving_ms: list[float] = field(default_factory=list)
    waiting_ms: list[float] = field(default_factory=list)


def measure_native(folder: Path, on_step: Callable[[str], None], timing: Timing = Timing()) -> dict[str, Any]:
    """Figures with native frames, first at their rate alone, then also with one solve after another.

    Raises:
        ConnectionFailedError: the daemon did not become ready.
    """
    with _settled(folder, "native", WindowConfig(slice_s=SLICE_S), on_step, timing) as (session, process):
        document = _resources(session, process, on_step, timing.measured)
        on_step("the daemon under load: queries during solves")
        return document | _round_trips(session, process, timing.measured)


def measure_ros(
    folder: Path, on_step: Callable[[str], None], timing: Timing = Timing(), program: tuple[str, ...] = SENSORS
) -> dict[str, Any]:
    """Figures with the same sensors as nodes of ROS, and windows of the default length.

    Raises:
        ConnectionFailedError: as `measure_native`.
    """
    with _settled(folder, "ros", WindowConfig(), on_step, timing, program) as (session, process):
        figures = _resources(session, process, on_step, timing.measured)
        return {f"ros_{name}": figure for name, figure in figures.items()}


def measure_rigs(
    folder: Path,
    on_step: Callable[[str], None],
    seconds: Mapping[str, float] = RIG_SECONDS,
    settle_s: float = RIG_SETTLE_S,
    pace: float = 1.0,
) -> dict[str, Any]:
    """Figures under each load of a whole vehicle that `seconds` names, one after the other.

    Args:
        pace: seconds of driving in a second. All figures are per second of driving, so that a machine with other load
            can be measured at a slower pace.

    Raises:
        ConnectionFailedError: as `measure_native`.
    """
    document: dict[str, Any] = {}
    for form, duration_s in seconds.items():
        with loaded(folder, form, (WindowConfig(), BudgetConfig()), on_step, pace) as (session, process):
            time.sleep(settle_s / pace)
            figures = _rig_figures(session, process, form, on_step, (duration_s, pace))
            document |= {f"{form}_{name}": figure for name, figure in figures.items()}
    return document


@contextmanager
def _settled(
    folder: Path,
    form: str,
    window: WindowConfig,
    on_step: Callable[[str], None],
    timing: Timing,
    program: tuple[str, ...] = SENSORS,
) -> Iterator[tuple[zenoh.Session, ProcessReading]]:
    """A daemon that has been under load for a while, with a budget that does not limit its worker."""
    stages = (window, BudgetConfig(cores=ENOUGH_CORES))
    with loaded(folder, form, stages, on_step, 1.0, program, timing.first_frame) as (session, process):
        _query(session, process, timing.settle, at_work=False)
        yield session, process


@contextmanager
def loaded(
    folder: Path,
    form: str,
    stages: tuple[WindowConfig, BudgetConfig],
    on_step: Callable[[str], None],
    pace: float = 1.0,
    program: tuple[str, ...] = SENSORS,
    first_frame_s: float = FIRST_FRAME_S,
) -> Iterator[tuple[zenoh.Session, ProcessReading]]:
    """A daemon under the load `form` of `sensors.LOADS`, at `pace` seconds of driving in a second, with a session:
    frames of every sensor arrive.

    Raises:
        ConnectionFailedError: the daemon did not become ready, or a sensor sends nothing.
    """
    on_step(f"the daemon starts, {form}")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    written = folder / f"{form}.yaml"
    # JSON is YAML.
    config = _configuration(endpoint, folder / form, form, *stages)
    written.write_text(config.model_dump_json(exclude_none=True))
    with (
        running("-m", "coec", "run", "--config", str(written)) as daemon,
        connected([endpoint], TIMEOUT_S) as session,
        running(*program, endpoint, form, str(pace)),
    ):
        on_step(f"the daemon under load, {form}")
        await_running(session)
        await_frames(session, first_frame_s)
        yield session, ProcessReading(daemon.pid)


def _resources(
    session: zenoh.Session, process: ProcessReading, on_step: Callable[[str], None], seconds: float
) -> dict[str, Any]:
    """Processor and memory of the I/O process, and what arrived in the meantime."""
    on_step("the daemon under load: processor and memory")
    process.reset_peak()
    cpu_s, begin_s = process.cpu_s, time.monotonic()
    before = _counters(session)
    _query(session, process, seconds, at_work=False)
    elapsed_s = time.monotonic() - begin_s
    after = _counters(session)
    return {
        "io_cpu_percent": 100.0 * (process.cpu_s - cpu_s) / elapsed_s,
        "io_resident_mb": process.peak_mb,
        "io_proportional_mb": process.proportional_mb,
        "io_per_second": {name: (after[name] - before[name]) / elapsed_s for name in after},
    }


def _round_trips(session: zenoh.Session, process: ProcessReading, seconds: float) -> dict[str, Any]:
    """Round trips of queries, while the worker solves and while it waits."""
    trips = _query(session, process, seconds, at_work=True)
    document: dict[str, Any] = {"query_during_solve_count": len(trips.solving_ms)}
    for name, times_ms in (("during_solve", trips.solving_ms), ("idle", trips.waiting_ms)):
        for percent in (50, 99):
            document[f"query_{name}_p{percent}_ms"] = float(np.percentile(times_ms, percent)) if times_ms else None
    return document


def _query(session: zenoh.Session, process: ProcessReading, seconds: float, *, at_work: bool) -> RoundTrips:
    """Queries the extrinsic all the time and, to keep the worker `at_work`, requests another solve as soon as it
    waits."""
    trips = RoundTrips()
    worker = ProcessReading(process.children[0])
    end_s = time.monotonic() + seconds
    next_command_s = 0.0
    while (now_s := time.monotonic()) < end_s:
        worker_s = worker.cpu_s
        begin_s = time.perf_counter()
        query_one(session, KEYS.extrinsic(PAIR), TIMEOUT_S)
        elapsed_s = time.perf_counter() - begin_s
        # The pace of the queries is part of what is measured.
        time.sleep(max(QUERY_PERIOD_S - (time.monotonic() - now_s), 0.0))
        busy = worker.cpu_s - worker_s >= BUSY_SHARE * QUERY_PERIOD_S
        (trips.solving_ms if busy else trips.waiting_ms).append(1e3 * elapsed_s)
        if at_work and not busy and now_s >= next_command_s:
            session.get(KEYS.command(PAIR, "calibrate"))  # it does not matter if there is no window to solve
            next_command_s = now_s + COMMAND_PERIOD_S
    return trips


def _counters(session: zenoh.Session) -> dict[str, int]:
    """Received frames and what they became, since the start; a stream that several pairs share counts once."""
    pairs = status(session)["pairs"]
    streams = {
        f"{kind}s": sum({pair["name"].split("-")[index]: pair[kind]["accepted"] for pair in pairs}.values())
        for index, kind in ((0, "camera"), (-1, "lidar"))
    }
    counted = {name: sum(pair[name] for pair in pairs) for name in ("pairs", "windows", "solved", "checks")}
    lost = sum(sum(pair["losses"].values()) for pair in pairs)
    return {**streams, **counted, "lost": lost}


def _rig_figures(
    session: zenoh.Session,
    service: ProcessReading,
    form: str,
    on_step: Callable[[str], None],
    duration: tuple[float, float],
) -> dict[str, Any]:
    """`duration`: seconds of driving, and how many of them pass in a second."""
    pairs, (seconds, pace) = sensors.LOADS[form].pairs, duration
    worker = ProcessReading(service.children[0])
    before, begin_s = status(session), time.monotonic()
    for process in (service, worker):
        process.reset_peak()
    service_s, worker_s = service.cpu_s, worker.cpu_s
    unseen_s = dict.fromkeys(pairs, 0.0)
    while time.monotonic() < begin_s + seconds / pace:
        time.sleep(READING_S / pace)
        driven_s = pace * (time.monotonic() - begin_s)
        on_step(f"the daemon under load, {form}: {driven_s:.0f} of {seconds:.0f} s of driving")
        for name in pairs:
            age_s = answered(session, KEYS.health(name))["age_s"]
            elapsed_s = time.monotonic() - begin_s
            unseen_s[name] = max(unseen_s[name], pace * (elapsed_s if age_s is None else age_s))
    elapsed_s = pace * (time.monotonic() - begin_s)
    io_percent = 100.0 * (service.cpu_s - service_s) / elapsed_s
    worker_percent = 100.0 * (worker.cpu_s - worker_s) / elapsed_s
    after = status(session)
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
        "health": Counter(answered(session, KEYS.health(name))["state"] for name in pairs),
    }


def _spent_s(status: dict[str, Any], kind: str) -> float:
    """Time that the worker has spent on a kind of work, s."""
    spent_s: float = status["budget"]["spent_s"].get(kind, 0.0)
    return spent_s


def _done(status: dict[str, Any], what: str) -> int:
    return sum(pair[what] for pair in status["pairs"])


def _configuration(endpoint: str, state: Path, form: str, window: WindowConfig, budget: BudgetConfig) -> Config:
    """Every camera paired with every LiDAR, as if all were at one place; the results do not matter."""
    what = sensors.LOADS[form]
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


def _place(what: sensors.Load, kind: str, index: int) -> dict[str, str]:
    return {"topic": sensors.TOPICS[kind]} if what.is_ros else {"key": sensors.key(kind, index)}


@contextmanager
def running(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """A Python process of ours, which is terminated at the end."""
    process = subprocess.Popen(
        [sys.executable, *arguments], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, cwd=PACKAGE_ROOT
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=TIMEOUT_S)


def await_running(session: zenoh.Session) -> None:
    """Wait until the service reports that it runs.

    Raises:
        ConnectionFailedError: it does not within `READY_S`.
    """
    end_s = time.monotonic() + READY_S
    while time.monotonic() < end_s:
        with suppress(NotFoundError):  # the router is there before the service
            if status(session)["state"] == "running":
                return
        time.sleep(POLL_S)
    raise ConnectionFailedError(f"the daemon of the benchmark did not become ready within {READY_S:g} s")


def await_frames(session: zenoh.Session, limit_s: float) -> None:
    """Wait until a frame of every camera and of every LiDAR has been accepted.

    Raises:
        ConnectionFailedError: none of one of them within the time limit.
    """
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        pairs = status(session)["pairs"]
        if all(pair[kind]["accepted"] for pair in pairs for kind in ("camera", "lidar")):
            return
        time.sleep(POLL_S)
    raise ConnectionFailedError(f"a sensor of the benchmark sent nothing that was accepted within {limit_s:g} s")


def status(session: zenoh.Session) -> dict[str, Any]:
    """Status of the daemon."""
    return answered(session, KEYS.status)


def answered(session: zenoh.Session, key: str) -> dict[str, Any]:
    """The document that is served on a key."""
    document: dict[str, Any] = json.loads(query_one(session, f"{key}?format=json", TIMEOUT_S).payload)
    return document


def free_port() -> int:
    """A port on which nothing listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
