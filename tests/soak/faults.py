"""Everything that is thrown at a running service in a soak, each so that it is over when the call returns."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from broken_disk import FULL, READ_ONLY, SLOW, WELL, BrokenDisk
from campaign import stepping_clock
from coec.config import LimitsConfig, ZenohConfig
from coec.io.zenoh.session import settings_of
from coec.schemas.keys import Keys
from e2e.processes import environment
from soak.vehicle import CAMERA, LIDAR, Vehicle

LARGE_BYTES = 30_000_000
RUBBISH = 100
COMMANDS = 200
LISTENER = """
import sys, time, zenoh
settings = zenoh.Config()
settings.insert_json5("mode", '"client"')
settings.insert_json5("connect/endpoints", '["%s"]' % sys.argv[1])
with zenoh.open(settings) as session:
    heard = [session.declare_subscriber(key, lambda _: None) for key in ("in/**", "coec/@v1/**")]
    print("listening", flush=True)
    time.sleep(3600)
"""


@dataclass
class Router:
    """The router of the vehicle, which goes and comes back. It hands over in shared memory, as Zenoh's own does."""

    endpoint: str
    _open: ExitStack = field(default_factory=ExitStack)

    def come(self) -> None:
        settings = settings_of(ZenohConfig(embedded_router=True, listen=(self.endpoint,)), LimitsConfig())
        settings.insert_json5("transport/shared_memory/enabled", "true")
        self._open.enter_context(zenoh.open(settings))

    def go(self) -> None:
        self._open.close()


@dataclass
class Bench:
    """What the faults need. `scale`: of all durations, 1 in a long soak."""

    service: int
    worker: Callable[[], int | None]
    session: zenoh.Session
    keys: Keys
    pair: str
    vehicle: Vehicle
    router: Router
    disk: BrokenDisk
    clock: Path
    rng: np.random.Generator
    scale: float
    answers: dict[str, int] = field(default_factory=dict)

    def passes(self, least_s: float, most_s: float) -> None:
        time.sleep(self.scale * float(self.rng.uniform(least_s, most_s)))


def worker_killed(bench: Bench) -> None:
    _signal(bench.worker(), signal.SIGKILL)


def worker_stopped(bench: Bench) -> None:
    _stopped(bench, bench.worker())


def service_stopped(bench: Bench) -> None:
    _stopped(bench, bench.service)


def router_gone(bench: Bench) -> None:
    bench.router.go()
    bench.passes(2.0, 10.0)
    bench.router.come()


def large_messages(bench: Bench) -> None:
    payload = bytes(LARGE_BYTES)
    for _ in range(max(round(8 * bench.scale), 2)):
        for stream in (CAMERA, LIDAR):
            bench.vehicle.put(stream, payload)


def rubbish(bench: Bench) -> None:
    for _ in range(RUBBISH):
        bench.vehicle.put(str(bench.rng.choice([CAMERA, LIDAR])), bench.rng.bytes(int(bench.rng.integers(0, 5000))))


def listeners_that_stop(bench: Bench) -> None:
    """Three who hear everything, and then read nothing more."""
    command = [sys.executable, "-c", LISTENER, bench.router.endpoint]
    listeners = [subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE) for _ in range(3)]
    try:
        for one in listeners:
            assert one.stdout is not None
            assert one.stdout.readline() == b"listening\n"
            one.send_signal(signal.SIGSTOP)
        bench.passes(3.0, 12.0)
    finally:
        for one in listeners:
            one.kill()
            one.wait()
            assert one.stdout is not None
            one.stdout.close()


def disk_full(bench: Bench) -> None:
    _disk(bench, FULL)


def disk_read_only(bench: Bench) -> None:
    _disk(bench, READ_ONLY)


def disk_slow(bench: Bench) -> None:
    _disk(bench, SLOW)


def commands(bench: Bench) -> None:
    """A flood of them from many senders."""
    finished = threading.Semaphore(0)

    def count(reply: Any) -> None:
        reported = "answered" if reply.ok is not None else "refused"
        bench.answers[reported] = bench.answers.get(reported, 0) + 1

    names = ("calibrate", "hold", "reset", "rollback", "commission", "apply")
    for number in range(COMMANDS):
        key = bench.keys.command(bench.pair, names[number % len(names)])
        handler = zenoh.handlers.Callback(count, finished.release, indirect=False)
        bench.session.get(key, handler, payload=b"{}", attachment=f"sender {number % 40}".encode(), timeout=10.0)
    for _ in range(COMMANDS):
        finished.acquire(timeout=20.0)
    bench.session.get(bench.keys.command(bench.pair, "hold"), payload=b'{"release":true}')


def sensor_time_jumps(bench: Bench) -> None:
    for seconds in (3600.0, -50.0):
        bench.vehicle.step_time(seconds)
        bench.passes(1.0, 4.0)


def wall_clock_jumps(bench: Bench) -> None:
    for seconds in (-400 * 86_400.0, 3600.0, 0.0):
        stepping_clock.put(bench.clock, seconds)
        bench.passes(1.0, 3.0)


ALL: tuple[Callable[[Bench], None], ...] = (
    disk_full,
    worker_killed,
    rubbish,
    large_messages,
    worker_stopped,
    disk_slow,
    commands,
    router_gone,
    sensor_time_jumps,
    service_stopped,
    listeners_that_stop,
    disk_read_only,
    wall_clock_jumps,
)


def _disk(bench: Bench, state: str) -> None:
    bench.disk.becomes(state)
    bench.passes(4.0, 16.0)
    bench.disk.becomes(WELL)


def _stopped(bench: Bench, pid: int | None) -> None:
    _signal(pid, signal.SIGSTOP)
    bench.passes(1.0, 5.0)
    _signal(pid, signal.SIGCONT)


def _signal(pid: int | None, number: int) -> None:
    if pid is not None:
        with suppress(ProcessLookupError):
            os.kill(pid, number)
