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
from coec.cli.demo.daemon import Daemon, DemoError, free_endpoint, running
from coec.cli.demo.story import MIN_FREE_BYTES, STORY_CORES
from coec.cli.rig_configuration import document_of
from coec.config import Config, load_config
from coec.schemas.base import from_json
from coec.schemas.keys import Keys
from coec.schemas.replies import HealthReply, StatusReply
from coec.schemas.rig_state import RigReply

if TYPE_CHECKING:
    from coec.simulation.rig_drive import RigDrive

START_S = 600.0
"""To come up. The first run on a machine compiles the kernels, for about a minute of two quiet cores and many of busy
ones; a service that ends meanwhile is noticed at once."""

ASK_S = 10.0
"""For one answer, on a machine that also draws the street."""

ANSWERED_S = 120.0
"""For what was sent to be looked at."""

REST_S = 8.0
"""Without anything to do, after which nothing comes any more: twice as long as the rig waits for what may be under way
(`runtime.rig.keeper.QUIET_TICKS`)."""

POLL_S = 0.1


class Service:
    """A running one, as a client sees it.

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
        """What it says of the rig."""
        return from_json(RigReply, self._ask(self._keys.rig))

    def health(self) -> Mapping[str, HealthReply]:
        """Of each pair."""
        return {pair: from_json(HealthReply, self._ask(self._keys.health(pair))) for pair in self.sensors_of}

    def status(self) -> StatusReply:
        """Of the service."""
        return from_json(StatusReply, self._ask(self._keys.status))

    def until_ready(self) -> None:
        """Until it runs and its worker is warm.

        Raises:
            DemoError: it ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + START_S
        while not (ask(self.session, self._keys.status, ASK_S) and self.status().state == "running"):
            self._go_on(deadline_s, "is not ready")

    def until_taken(self, pictures: int, most_held: int) -> None:
        """Until it has so many pictures of every camera, and at most so many pairs wait to be looked at.

        Raises:
            DemoError: it ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + ANSWERED_S
        while any(pair.camera.received < pictures or pair.held > most_held for pair in self.status().pairs):
            self._go_on(deadline_s, f"has not looked at {pictures} pictures of each camera")

    def until_at_rest(self) -> None:
        """Until nothing waits and nothing is under way, for as long as the rig takes to see that nothing comes.

        Raises:
            DemoError: it ends before, or it takes too long.
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
            raise DemoError(f"the service {what} in time; {self._daemon.last_words()}")
        time.sleep(POLL_S)

    def _ask(self, key: str) -> bytes:
        return ask_one(self.session, f"{key}?format=json", ASK_S).payload


@contextmanager
def serving(drive: RigDrive, lidar: str) -> Iterator[Service]:
    """One that knows nothing but where the rig was built, as it starts.

    Raises:
        DemoError: it does not start or answer, or ends before its time.
        OutputError: its configuration cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="coec-demo-") as temporary:
        folder = Path(temporary)
        endpoint = free_endpoint()
        document: dict[str, Any] = {
            **document_of(drive, (lidar,), folder),
            # The drive passes faster than on a road, and the cameras are drawn on the processor that looks.
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
