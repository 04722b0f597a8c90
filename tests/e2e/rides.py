"""A drive with a step in the mount, and a service that is driven with it: sensor time runs faster than the clock, and
the service keeps up or lets the stream wait, as it likes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from coec.adapters.frames.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.adapters.zenoh.bus import MSGPACK
from coec.adapters.zenoh.client import ask_one, connected
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import CalibrationConfig, Config, MonitorConfig, PolicyConfig, WindowConfig, load_config
from coec.geometry.se3 import inverse, rotation_angle_rad
from coec.reports.commented_yaml import commented_yaml
from coec.schemas.keys import Keys
from coec.simulation.drive import SimulatedDrive
from coec.sources import Recording, open_source
from e2e.processes import Service, service, write_configuration

SECONDS, STEP_S, RATE_HZ = 100, 40, 1.0
SOURCE = f"sim:seed=1&seconds={SECONDS}&camera=pinhole480x240&lidar=32&camera_hz={RATE_HZ}&lidar_hz={RATE_HZ}&depth=yes"
STEP = f"&faults=step:{STEP_S}:ry=1"
"""One degree in yaw, when one window and several looks have passed."""

SPEED = 8.0
"""Seconds of the drive per second."""

CHECK_S = 5.0
PATIENCE_S = 180.0
POLL_S = 0.05
AT_REST = 4
"""Polls at which nothing waits and nothing is under way, one after the other."""

Frame = CameraFrame | LidarFrame | EgoMotion


@cache
def drive() -> tuple[Recording, tuple[Frame, ...]]:
    """The recording and its frames, drawn once for all tests."""
    recording = open_source(SOURCE + STEP)
    return recording, tuple(recording.messages())


def between(begin_s: float, end_s: float) -> list[Frame]:
    """The frames of a part of the drive, in the order in which they are sent; no pair is torn."""
    start_ns = drive()[0].camera_stamps_ns[0]
    return [frame for frame in drive()[1] if begin_s <= (frame.stamp_ns - start_ns) / 1e9 + 0.5 / RATE_HZ < end_s]


def configured(folder: Path, calibration: CalibrationConfig, policy: PolicyConfig | None = None) -> Path:
    """A configuration for the drive, with short windows."""
    folder.mkdir(parents=True, exist_ok=True)
    path = write_configuration(folder, SOURCE, np.zeros(6), calibration)
    config = load_config(path)
    pair = config.pairs[0].model_copy(
        update={
            "window": WindowConfig(pairs=16, min_pairs=8, slice_s=32.0),
            "monitor": MonitorConfig(period_s=CHECK_S, pairs=5, min_pairs=4, urgent_slice_s=16.0),
            "policy": policy or PolicyConfig(),
        }
    )
    path.write_text(commented_yaml(config.model_copy(update={"pairs": (pair,)})))
    return path


@dataclass
class Ride:
    """A client that drives, and asks."""

    running: Service
    session: zenoh.Session
    config: Config
    paced: threading.Event = field(default_factory=threading.Event)
    """Never set: the sender's pace."""

    @property
    def keys(self) -> Keys:
        return Keys(self.config.prefix, self.config.vehicle)

    @property
    def pair(self) -> str:
        return self.config.pairs[0].name

    def ask(self, key: str, parameters: str = "", payload: bytes | None = None) -> Any:
        reply = ask_one(self.session, f"{key}?format=json{parameters}", 10.0, payload)
        return json.loads(reply.payload)

    def health(self) -> Any:
        return self.ask(self.keys.health(self.pair))

    def extrinsic(self) -> Any:
        return self.ask(self.keys.extrinsic(self.pair))

    def entries(self, *kinds: str) -> list[Any]:
        """Of the history, of these kinds."""
        kept = self.ask(self.keys.history(self.pair))["entries"]
        return [one["entry"] for one in kept if one["entry"]["kind"] in kinds]

    def status(self) -> Any:
        """Of the pair."""
        return self.ask(self.keys.status)["pairs"][0]

    def command(self, name: str, payload: bytes | None = None) -> Any:
        return self.ask(self.keys.command(self.pair, name), "", payload)

    def send(self, frames: Sequence[Frame], speed: float = SPEED) -> None:
        """Sends frames when they are due, whether the service keeps up or not."""
        began_s = time.monotonic()
        for frame in frames:
            due_s = began_s + (frame.stamp_ns - frames[0].stamp_ns) / 1e9 / speed
            self.paced.wait(max(due_s - time.monotonic(), 0.0))
            name, payload = encoded(frame)
            self.session.put(f"sensors/{self.pair}/{name}", payload, encoding=MSGPACK)

    def rest(self) -> None:
        """Until nothing waits and nothing is under way."""
        quiet = 0
        deadline_s = time.monotonic() + PATIENCE_S
        while quiet < AT_REST:
            assert time.monotonic() < deadline_s, "the service does not come to rest"
            quiet = quiet + 1 if self._rests() else 0
            self.paced.wait(POLL_S)

    def end(self) -> None:
        """Until the streams have been silent for long enough to end the open window, and it was judged."""
        deadline_s = time.monotonic() + PATIENCE_S
        while self.status()["selected"] > 0:
            assert time.monotonic() < deadline_s, "the open window does not end"
            self.paced.wait(POLL_S)
        self.rest()

    def _rests(self) -> bool:
        status = self.ask(self.keys.status)
        worker, pair = status["worker"], status["pairs"][0]
        return bool(worker["state"] == "idle" and worker["queued"] == 0 and pair["held"] == 0)


@contextmanager
def riding(config: Path) -> Iterator[Ride]:
    """A ride with a service of its own, whose worker is ready."""
    loaded = load_config(config)
    with service(config) as running, connected(loaded.zenoh.connect, 30.0) as session:
        ride = Ride(running, session, loaded)
        ride.rest()
        yield ride
        assert running.terminate() == 0


def encoded(frame: Frame) -> tuple[str, bytes]:
    """The stream of a frame, and its message."""
    match frame:
        case CameraFrame():
            return "camera", encode_camera(frame)
        case LidarFrame():
            return "lidar", encode_lidar(frame)
        case EgoMotion():
            return "ego", encode_ego(frame)


def without_depth(frame: Frame) -> Frame:
    """A frame as a real camera sends it."""
    return replace(frame, depth=None) if isinstance(frame, CameraFrame) else frame


def error_deg(extrinsic: Any, second: float) -> float:
    """Against the truth at this time of the drive."""
    recording = drive()[0]
    assert isinstance(recording, SimulatedDrive)
    right = recording.truth(recording.camera_stamps_ns[0] + round(second * 1e9))
    served = np.array(extrinsic["camera_from_lidar"]["matrix"])
    return float(np.degrees(rotation_angle_rad(served @ inverse(right))))
