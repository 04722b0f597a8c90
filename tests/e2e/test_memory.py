"""A burst of the largest messages that are taken: what it took in memory is given back."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from coec.calibration.types import LidarFrame
from coec.io.msgpack_frames import encode_lidar
from e2e.processes import Router, service
from soak.vehicle import CAMERA, LIDAR, Vehicle, configured
from support.fake_worker import wait_until

MIB = 2**20
BURST_S = 15.0
BACK_MIB = 50.0
BACK_S = 60.0
MOST_MIB = 700.0
"""Above what it was before: `max_held_bytes` and a half, `max_waiting_bytes`, and some messages on their way."""

MANY_POINTS = 990_000
"""Just below `limits.max_points`; with all columns 22 MB."""


def sweep(points: int) -> bytes:
    rng = np.random.default_rng(0)
    cloud = rng.normal(0.0, 10.0, (points, 3)).astype(np.float32)
    column = np.zeros(points, np.float32)
    return encode_lidar(LidarFrame(0, "lidar", cloud, column, column.astype(np.uint16), column))


@pytest.mark.slow
@pytest.mark.fault(
    "15 s of messages of 22 and 30 MB",
    "memory stays below 700 MiB more than before, and is back within 50 MiB of before in a minute",
)
def test_memory_comes_back_after_a_burst(tmp_path: Path, router: Router, record_property: Any) -> None:
    payloads = (bytes(30_000_000), sweep(MANY_POINTS))
    most = 0
    with service(configured(tmp_path, router.endpoint), router) as running:
        process = psutil.Process(running.process.pid)
        vehicle = Vehicle(router.session, 1)
        vehicle.start()
        finished = threading.Event()

        def watch() -> None:
            nonlocal most
            while not finished.wait(0.02):
                most = max(most, process.memory_info().rss)

        watcher = threading.Thread(target=watch)
        try:
            running.until(running.counters, lambda pair: pair["checks"] > 1, "two checks")
            before = process.memory_info().rss
            watcher.start()
            end_s = time.monotonic() + BURST_S
            while time.monotonic() < end_s:
                for stream in (CAMERA, LIDAR):
                    for payload in payloads:
                        vehicle.put(stream, payload)
            started_s = time.monotonic()
            wait_until(lambda: process.memory_info().rss < before + BACK_MIB * MIB, "the memory back", BACK_S)
            back_s = time.monotonic() - started_s
        finally:
            finished.set()
            vehicle.stop()
        assert running.terminate() == 0
    figure = f"at most {(most - before) / MIB:+.0f} MiB, back within {BACK_MIB:g} MiB after {back_s:.0f} s"
    record_property("figure", figure)
    assert most - before < MOST_MIB * MIB
