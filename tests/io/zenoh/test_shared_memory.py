"""A service that runs for months keeps no memory of routers and senders that have gone."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from typing import Any

import pytest
import zenoh

from coec.io.zenoh.ros_node import has_subscribers
from e2e.processes import environment
from support.fake_worker import wait_until
from support.router import free_port

ROUTERS, MESSAGES = 3, 8
PAYLOAD = bytes(2_000_000)
POOL_MIB = 16
"""Of a session of Zenoh that hands over in shared memory."""

RECEIVER = """
import sys
from coec.io.zenoh.bus import Bus, open_session
from coec.io.zenoh.bus import on_key
from coec.config import LimitsConfig, ZenohConfig
from pathlib import Path

def shared_kib(sample):
    lines = Path("/proc/self/status").read_text().splitlines()
    print(next(line.split()[1] for line in lines if line.startswith("RssShmem")), flush=True)

bus = Bus(open_session(ZenohConfig(connect=(sys.argv[1],)), LimitsConfig()))
bus.subscribe(on_key("in/camera"), shared_kib)
sys.stdin.read()
bus.undeclare_inputs()
bus.close(5.0)
"""


def settings(mode: str, endpoint: str, *, shares_memory: bool) -> zenoh.Config:
    """Those of anybody's session, by default in all else."""
    selected = zenoh.Config()
    reported = {
        "mode": mode,
        "listen/endpoints": [endpoint] if mode == "router" else [],
        "connect/endpoints": [] if mode == "router" else [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": shares_memory,
        "transport/shared_memory/mode": "init",  # from its first message on
    }
    for key, value in reported.items():
        selected.insert_json5(key, json.dumps(value))
    return selected


@pytest.mark.fault(
    "a router with shared memory, Zenoh's default, is restarted again and again",
    "none of its memory stays in the service",
)
def test_no_memory_of_routers_that_are_gone_is_retained(record_property: Any) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    shared_mib = []
    command = [sys.executable, "-c", RECEIVER, endpoint]
    with subprocess.Popen(
        command, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as receiver:
        assert receiver.stdin is not None
        assert receiver.stdout is not None
        for _ in range(ROUTERS):
            with (
                zenoh.open(settings("router", endpoint, shares_memory=True)),
                zenoh.open(settings("client", endpoint, shares_memory=False)) as session,
            ):
                sender = session.declare_publisher("in/camera", congestion_control=zenoh.CongestionControl.BLOCK)
                wait_until(partial(has_subscribers, sender), "the receiver")
                for _ in range(MESSAGES):
                    sender.put(PAYLOAD)
                report = [receiver.stdout.readline() for _ in range(MESSAGES)]
                shared_mib.append(int(report[-1]) / 1024)
        receiver.stdin.close()
    assert receiver.returncode == 0
    record_property("figure", f"{shared_mib[-1] - shared_mib[0]:+.0f} MiB after {ROUTERS} routers")
    assert shared_mib[-1] < POOL_MIB / 2, shared_mib
