"""The service of the demonstration of a rig: `coec run` with all sensors of the vehicle, a router, and a client."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh

from coec.adapters.files.output import write
from coec.adapters.zenoh.client import ask, ask_one, connected
from coec.adapters.zenoh.player import SensorKeys
from coec.cli.rig_configuration import document_of
from coec.config import Config, load_config
from coec.schemas.base import from_json
from coec.schemas.keys import Keys
from coec.schemas.replies import HealthReply, StatusReply
from coec.schemas.rig_state import RigReply
from coec_lab.demo.daemon import Daemon, DemoError, free_endpoint, running
from coec_lab.demo.story import MIN_FREE_BYTES, STORY_CORES

if TYPE_CHECKING:
    from coec.simulation.rig_drive import RigDrive

START_S = 600.0
"""Time limit of the start. The first run on a machine compiles the kernels, for about a minute on two idle cores and
many on busy ones; if the service ends in the meantime, that is noticed at once."""

ASK_S = 10.0
"""Timeout of one answer, on a machine that also draws the street."""

ANSWERED_S = 120.0
"""Time limit for the service to look at what was sent."""

REST_S = 8.0
"""Idle time after which nothing more comes: twice as long as the rig waits for looks that may be in transit
(`runtime.rig.keeper.QUIET_TICKS`)."""

POLL_S = 0.1


class Service:
    """A running service, as a client sees it.

    Attributes:
        sensors: keys on which it listens.
        sensors_of: camera and LiDAR of each pair.
    """

    def __init__(self, session: zenoh.Session, config: Config, daemon: Daemon, sensors: SensorKeys) -> None:
        self.session = session
        self.sensors = sensors
        self._keys = Keys(config.prefix, config.vehicle)
        self.sensors_of = {pair.name: (pair.camera.sensor, pair.lidar.sensor) for pair in config.pairs}
        self._daemon = daemon

    def rig(self) -> RigReply:
        """What the service says about the rig."""
        return from_json(RigReply, self._ask(self._keys.rig))

    def health(self) -> Mapping[str, HealthReply]:
        """Health of each pair."""
        return {pair: from_json(HealthReply, self._ask(self._keys.health(pair))) for pair in self.sensors_of}

    def status(self) -> StatusReply:
        """Status of the service."""
        return from_json(StatusReply, self._ask(self._keys.status))

    def until_ready(self) -> None:
        """Waits until the service runs and its worker is warm.

        Raises:
            DemoError: the service ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + START_S
        while not (ask(self.session, self._keys.status, ASK_S) and self.status().state == "running"):
            self._go_on(deadline_s, "is not ready")

    def until_taken(self, pictures: int, most_held: int) -> None:
        """Waits until the service has so many pictures of every camera, and at most `most_held` frame pairs wait.

        Raises:
            DemoError: the service ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + ANSWERED_S
        while any(pair.camera.received < pictures or pair.held > most_held for pair in self.status().pairs):
            self._go_on(deadline_s, f"has not looked at {pictures} pictures of each camera")

    def until_at_rest(self) -> None:
        """Waits until nothing has been waiting or in progress for `REST_S`, so that the rig knows that nothing comes.

        Raises:
            DemoError: the service ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + ANSWERED_S
        quiet_s = time.monotonic()
        while time.monotonic() < quiet_s + REST_S:
            if any(pair.held or pair.unanswered for pair in self.status().pairs):
                quiet_s = time.monotonic()
            self._go_on(deadline_s, "does not come to rest")

    def _go_on(self, deadline_s: float, what: str) -> None:
        self._daemon.check()
        if time.monotonic() > deadline_s:
            raise DemoError(f"the service {what} in time", self._daemon.last_words())
        time.sleep(POLL_S)

    def _ask(self, key: str) -> bytes:
        return ask_one(self.session, f"{key}?format=json", ASK_S).payload


@contextmanager
def serving(drive: RigDrive, lidar: str) -> Iterator[Service]:
    """A starting service that knows nothing but how the rig was built.

    Raises:
        DemoError: the service does not start or answer, or ends early.
        OutputError: its configuration cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="coec-demo-") as temporary:
        folder = Path(temporary)
        endpoint = free_endpoint()
        document: dict[str, Any] = {
            **document_of(drive, (lidar,), folder),
            # The drive is faster than on a road, and the pictures are drawn on the same processor.
            "budget": {"cores": STORY_CORES},
            "worker": {"niceness": 0},
            "zenoh": {"connect": [endpoint], "listen": [endpoint]},
            "state": {"directory": "state", "min_free_bytes": MIN_FREE_BYTES},
        }
        path = write(folder / "coec.yaml", json.dumps(document).encode())  # which is YAML, too
        config = load_config(path)
        with running(path, folder / "coec.log") as daemon, connected(config.zenoh.connect, START_S) as session:
            service = Service(session, config, daemon, SensorKeys(("ego", lidar, *drive.cameras)))
            yield service
            daemon.end()
