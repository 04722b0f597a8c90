"""A vehicle at full rate with everything thrown at its service, over and over: every message is accounted for, and
memory stays what it was.

Three minutes in the long gate, a quarter of a minute always; `COEC_SOAK_S=1800` is half an hour.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from broken_disk import BrokenDisk
from campaign import stepping_clock
from coec.io.zenoh.query_client import connected
from e2e.processes import Router as ForClients
from e2e.processes import Service, free_endpoint, service
from soak import faults
from soak.faults import Bench, Router
from soak.vehicle import CAMERA, EGO, LIDAR, Vehicle, configured
from support.fake_worker import wait_until

MIB = 2**20
MEMORY_MIB = 30.0
SETTLED_SHARE = 1.0 / 6.0
"""Of the whole, after which memory is compared: minute five of thirty."""

QUIET_S = 2.0
"""Of sending after the last fault: late numbers are counted as lost with the next 16 frames."""

REST_S = 60.0
"""The worker may have to be started anew, and answer what it was asked, before the last pair is looked at."""

CONNECTED_S = 20.0

RENEWALS = 2
"""Of the status, one a second, until it says of the last frame what became of it."""

CLOCK = Path(stepping_clock.__file__)
LONG_S = float(os.environ.get("COEC_SOAK_S", "180"))


def accounted(counters: Any, sent: Counter[str], stream: str) -> tuple[int, int]:
    """Messages of a stream that were sent, and those of which the service says what became of them."""
    counts = counters[stream]
    losses = counts["losses"]
    unseen = losses.get("overrun", 0) + losses.get("sequence_gap", 0)
    return sent[stream] + sent[f"{stream} of others"], counts["received"] + unseen


def frames_accounted(counters: Any, stream: str) -> tuple[int, int]:
    """Frames that were made, and those that are part of a pair or lost by a cause of the pairing."""
    losses = counters[stream]["losses"]
    finished = sum(
        losses.get(cause, 0) for cause in ("unpaired", "surplus", "stamp_back", "stamp_ahead", "memory_full")
    )
    return counters[stream]["accepted"], counters["pairs"] + finished


def soak(folder: Path, seconds: float, scale: float, seed: int) -> dict[str, Any]:
    """The figures of so many seconds."""
    endpoint = free_endpoint()
    path = configured(folder, endpoint)
    clock, disk = folder / "clock", BrokenDisk(folder / "state", folder / "disk")
    stepping_clock.put(clock, 0.0)
    router = Router(endpoint)
    router.come()
    done: Counter[str] = Counter()
    program = (sys.executable, str(CLOCK), str(clock))
    with ExitStack() as opened:
        session = opened.enter_context(connected([endpoint], CONNECTED_S))
        opened.enter_context(disk.on_path())
        running = opened.enter_context(service(path, ForClients(session, endpoint), program=program))
        vehicle = Vehicle(session, seed)
        process = psutil.Process(running.process.pid)
        bench = Bench(
            running.process.pid,
            lambda: next((child.pid for child in process.children()), None),
            session,
            running.keys,
            running.pair,
            vehicle,
            router,
            disk,
            clock,
            np.random.default_rng(seed),
            scale,
        )
        vehicle.start()
        try:
            figures = _throw(bench, process, seconds, done)
            time.sleep(QUIET_S)
        finally:
            vehicle.stop()
        figures |= _account(running, vehicle)
        assert running.terminate() == 0
    router.go()
    return {**figures, "faults": dict(done), "commands": bench.answers}


def _throw(bench: Bench, process: psutil.Process, seconds: float, done: Counter[str]) -> dict[str, Any]:
    begin_s = time.monotonic()
    settled_bytes = 0
    every: list[Any] = []
    while (passed_s := time.monotonic() - begin_s) < seconds or len(done) < len(faults.ALL):
        if not settled_bytes and passed_s > SETTLED_SHARE * seconds and len(done) == len(faults.ALL):
            bench.passes(5.0, 5.0)
            settled_bytes = process.memory_info().rss
        every = every or [faults.ALL[index] for index in bench.rng.permutation(len(faults.ALL))]
        fault = every.pop()
        fault(bench)
        done[fault.__name__] += 1
        bench.passes(0.5, 4.0)
        assert process.status() != psutil.STATUS_ZOMBIE, f"the service has ended after {fault.__name__}"
    bench.passes(5.0, 5.0)
    rss_bytes = process.memory_info().rss
    return {"rss_mib": rss_bytes / MIB, "grown_mib": (rss_bytes - (settled_bytes or rss_bytes)) / MIB}


def _account(running: Service, vehicle: Vehicle) -> dict[str, Any]:
    """What the service says once its streams have been silent for long enough: then every pair is certain."""

    seen: list[float] = []

    def rests() -> bool:
        status = running.status()
        (pair,) = status["pairs"]
        if pair["held"] > 0 or len(set(frames_accounted(pair, LIDAR))) > 1:
            return False
        seen.append(status["uptime_s"])
        return len(set(seen)) > RENEWALS

    with suppress(AssertionError):  # then the figures tell
        wait_until(rests, "the end of the pairs", REST_S)
    counters = running.counters()
    return {
        "messages": {stream: accounted(counters, vehicle.sent, stream) for stream in (CAMERA, LIDAR, EGO)},
        "frames": {stream: frames_accounted(counters, stream) for stream in (CAMERA, LIDAR)},
        "losses": {stream: counters[stream]["losses"] for stream in (CAMERA, LIDAR, EGO)},
        "counters": {name: counters[name] for name in ("pairs", "windows", "checks", "solved", "losses", "held")},
        "reasons": [reason["code"] for reason in running.health()["reasons"]],
    }


def check(figures: dict[str, Any]) -> None:
    print(f"\n{json.dumps(figures, indent=1)}")
    for sent, reported in figures["messages"].values():
        assert reported == sent, figures
    for made, reported in figures["frames"].values():
        assert reported == made, figures
    assert set(figures["faults"]) == {fault.__name__ for fault in faults.ALL}
    assert not {"history_damaged", "state_damaged"} & set(figures["reasons"]), figures["reasons"]
    assert figures["commands"].get("answered", 0) > 0


def test_everything_once_and_every_message_is_accounted_for(tmp_path: Path) -> None:
    check(soak(tmp_path, 0.0, 0.06, 1))


@pytest.mark.slow
@pytest.mark.fault(
    "every fault at full rate for half an hour (three minutes in the gate)",
    "every message is accounted for; memory (RSS) at the end within 30 MiB of minute five",
)
def test_a_long_soak(tmp_path: Path, record_property: Any) -> None:
    figures = soak(tmp_path, LONG_S, min(LONG_S / 600.0, 1.0), 2)
    check(figures)
    total = sum(sent for sent, _ in figures["messages"].values())
    record_property("figure", f"{total} messages in {LONG_S:g} s, memory {figures['grown_mib']:+.0f} MiB")
    assert figures["grown_mib"] < MEMORY_MIB
