"""The service of the demonstrations: `coec run` as a process of its own, as on a vehicle; for a rig, with a client."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh

import coec
from coec.config import Config, load_config
from coec.errors import CoecError
from coec.io.user_files import write_output
from coec.io.zenoh.player import SensorKeys
from coec.io.zenoh.query_client import connected, query_all, query_one
from coec.schemas.keys import Keys
from coec.schemas.message import from_json
from coec.schemas.replies import HealthReply, StatusReply
from coec.schemas.rig_state import RigReply
from coec_lab.simulation.source import document_of

if TYPE_CHECKING:
    from coec_lab.simulation.rig_drive import RigDrive

STORY_CORES = 64.0
"""Budget of the service: in a demonstration, windows come every few seconds, for which the default is too small."""

MIN_FREE_BYTES = 64 * 2**20
"""Small, because a demonstration writes only some windows of 20 MB."""

STOP_S = 15.0
"""Time within which `coec run` promises to stop."""

LOG_TAIL_LINES = 5
"""Lines of the service's log that are shown when it fails."""


class DemoError(CoecError):
    """The service of a demonstration failed."""

    reply_code = "demo_failed"


class Daemon:
    """A running service; its log goes to a file."""

    def __init__(self, child: subprocess.Popen[bytes], log: Path) -> None:
        self._child = child
        self._log = log

    def check(self) -> None:
        """Raises DemoError, with the last lines of the log, when the service has ended."""
        if self._child.poll() is not None:
            raise DemoError(f"the service ended with status {self._child.returncode}", self.log_tail())

    def log_tail(self) -> str:
        """The last lines of the log, for error messages."""
        lines = self._log.read_text(errors="replace").splitlines()[-LOG_TAIL_LINES:]
        return "last lines of its log:\n" + "\n".join(_plain(line) for line in lines)

    def end(self) -> None:
        """Requests the service to stop, and waits.

        Raises:
            DemoError: it does not end, or not with status 0.
        """
        self._child.send_signal(signal.SIGTERM)
        try:
            status = self._child.wait(STOP_S)
        except subprocess.TimeoutExpired as error:
            raise DemoError(f"the service did not end within {STOP_S:g} s") from error
        if status != 0:
            raise DemoError(f"the service ended with status {status}")


@contextmanager
def running(config: Path, log: Path) -> Iterator[Daemon]:
    """`coec run --embedded-router` with a configuration; killed at the end if it still runs."""
    command = [sys.executable, "-m", "coec", "run", "--config", str(config), "--embedded-router"]
    # The child finds the package where this process did, even if it is not installed.
    path = os.pathsep.join(filter(None, [str(Path(coec.__file__).parent.parent), os.environ.get("PYTHONPATH")]))
    with log.open("wb") as stream:
        child = subprocess.Popen(command, stdout=stream, stderr=stream, env={**os.environ, "PYTHONPATH": path})
    try:
        yield Daemon(child, log)
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()


def free_endpoint() -> str:
    """A Zenoh endpoint on this machine that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return f"tcp/127.0.0.1:{port}"


def _plain(line: str) -> str:
    """The message of a JSON log line; any other line as it is."""
    try:
        record = json.loads(line)
    except ValueError:
        return line
    return f"{record.get('level')}: {record.get('message')}" if isinstance(record, dict) else line


START_S = 600.0
"""Time limit of the start. The first run on a machine compiles the kernels, for about a minute on two idle cores and
many on busy ones; if the service ends in the meantime, that is noticed at once."""

QUERY_S = 10.0
"""Timeout of one answer, on a machine that also renders the street."""

ANSWERED_S = 120.0
"""Time limit for the service to check what was sent."""

REST_S = 8.0
"""Idle time after which nothing more comes: twice as long as the rig waits for checks that may be in transit
(`service.engine.rig.QUIET_TICKS`)."""

POLL_S = 0.1


def query_json(session: zenoh.Session, key: str) -> bytes:
    """The JSON reply of the service at a key.

    Raises:
        CoecError: no reply in time, or one that refuses the query.
    """
    return query_one(session, f"{key}?format=json", QUERY_S).payload


class RigService:
    """A running service, as a client sees it.

    Attributes:
        sensors: keys to which it subscribes.
        sensors_of: camera and LiDAR of each pair.
    """

    def __init__(self, session: zenoh.Session, config: Config, daemon: Daemon, sensors: SensorKeys) -> None:
        self.session = session
        self.sensors = sensors
        self._keys = Keys(config.prefix, config.vehicle)
        self.sensors_of = {pair.name: (pair.camera.sensor, pair.lidar.sensor) for pair in config.pairs}
        self._daemon = daemon

    def rig(self) -> RigReply:
        """State of the rig, as the service reports it."""
        return from_json(RigReply, query_json(self.session, self._keys.rig))

    def health(self) -> Mapping[str, HealthReply]:
        """Health of each pair."""
        return {
            pair: from_json(HealthReply, query_json(self.session, self._keys.health(pair))) for pair in self.sensors_of
        }

    def status(self) -> StatusReply:
        """Status of the service."""
        return from_json(StatusReply, query_json(self.session, self._keys.status))

    def until_ready(self) -> None:
        """Waits until the service runs and its worker is warm.

        Raises:
            DemoError: the service ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + START_S
        while not (query_all(self.session, self._keys.status, QUERY_S) and self.status().state == "running"):
            self._wait(deadline_s, "is not ready")

    def until_taken(self, pictures: int, most_held: int) -> None:
        """Waits until the service has so many pictures of every camera, and at most `most_held` frame pairs wait.

        Raises:
            DemoError: the service ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + ANSWERED_S
        while any(pair.camera.received < pictures or pair.held > most_held for pair in self.status().pairs):
            self._wait(deadline_s, f"has not checked {pictures} pictures of each camera")

    def until_at_rest(self) -> None:
        """Waits until nothing has been waiting or in progress for `REST_S`, so that no result is pending.

        Raises:
            DemoError: the service ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + ANSWERED_S
        quiet_s = time.monotonic()
        while time.monotonic() < quiet_s + REST_S:
            if any(pair.held or pair.unanswered for pair in self.status().pairs):
                quiet_s = time.monotonic()
            self._wait(deadline_s, "does not come to rest")

    def _wait(self, deadline_s: float, what: str) -> None:
        self._daemon.check()
        if time.monotonic() > deadline_s:
            raise DemoError(f"the service {what} in time", self._daemon.log_tail())
        time.sleep(POLL_S)


@contextmanager
def serving(drive: RigDrive, lidar: str) -> Iterator[RigService]:
    """A starting service that is configured with the rig as it was built.

    Raises:
        DemoError: the service does not start or answer, or ends early.
        OutputError: its configuration cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="coec-demo-") as temporary:
        folder = Path(temporary)
        endpoint = free_endpoint()
        document: dict[str, Any] = {
            **document_of(drive, (lidar,), folder),
            # The drive is faster than on a road, and the pictures are rendered on the same processor.
            "budget": {"cores": STORY_CORES},
            "worker": {"niceness": 0},
            "zenoh": {"connect": [endpoint], "listen": [endpoint]},
            "state": {"directory": "state", "min_free_bytes": MIN_FREE_BYTES},
        }
        path = write_output(folder / "coec.yaml", json.dumps(document).encode())  # which is YAML, too
        config = load_config(path)
        with running(path, folder / "coec.log") as daemon, connected(config.zenoh.connect, START_S) as session:
            service = RigService(session, config, daemon, SensorKeys(("ego", lidar, *drive.cameras)))
            yield service
            daemon.end()
