"""Starts, asks and ends a daemon of the benchmark, which is a process of its own."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import zenoh

from coec.adapters.zenoh.client import ask_one
from coec.errors import ConnectionFailedError, NotFoundError
from coec.runtime.worker.child import PACKAGE_ROOT
from coec.schemas.keys import Keys

TIMEOUT_S = 60.0
"""Timeout of an answer, and of the end of a process."""

POLL_S, READY_S = 0.1, 300.0
"""Period of asking whether the daemon runs, because it cannot announce that; and the time limit, because a first start
compiles every kernel, for a minute and a half on two busy cores."""

FLOWING_S = 60.0
"""Time limit for the first frame of every sensor, once the daemon runs."""

SENSORS = "import sys; from coec_lab.bench import load; sys.exit(load.main(*sys.argv[1:]))"
"""Program of the process that sends frames; its arguments are those of `load.main`."""


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


def await_running(session: zenoh.Session, keys: Keys) -> None:
    """Wait until the service says that it runs.

    Raises:
        ConnectionFailedError: it does not within `READY_S`.
    """
    end_s = time.monotonic() + READY_S
    while time.monotonic() < end_s:
        with suppress(NotFoundError):  # the router is there before the service
            if status(session, keys)["state"] == "running":
                return
        time.sleep(POLL_S)
    raise ConnectionFailedError(f"the daemon of the benchmark did not become ready within {READY_S:g} s")


def await_frames(session: zenoh.Session, keys: Keys) -> None:
    """Wait until a frame of every camera and of every LiDAR has been accepted.

    Raises:
        ConnectionFailedError: none came from one of them within `FLOWING_S`.
    """
    end_s = time.monotonic() + FLOWING_S
    while time.monotonic() < end_s:
        pairs = status(session, keys)["pairs"]
        if all(pair[kind]["accepted"] for pair in pairs for kind in ("camera", "lidar")):
            return
        time.sleep(POLL_S)
    raise ConnectionFailedError(f"a sensor of the benchmark sent nothing that was accepted within {FLOWING_S:g} s")


def status(session: zenoh.Session, keys: Keys) -> dict[str, Any]:
    """Status of the daemon."""
    return answered(session, keys.status)


def answered(session: zenoh.Session, key: str) -> dict[str, Any]:
    """The document that is served on a key."""
    document: dict[str, Any] = json.loads(ask_one(session, f"{key}?format=json", TIMEOUT_S).payload)
    return document


def free_port() -> int:
    """A port on which nothing listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
