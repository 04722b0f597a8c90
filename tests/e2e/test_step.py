"""A mount that moves by one degree while the service runs: noticed, told, corrected, remembered; with `apply: never`
told, and left to people. Sensor time is compressed: the drive waits for the service, not for the clock."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from coec.adapters.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.adapters.zenoh_bus import MSGPACK
from coec.adapters.zenoh_client import ask_one, connected
from coec.calibration.values import CameraFrame, EgoMotion, LidarFrame
from coec.cli.commented_yaml import commented_yaml
from coec.config import (
    CalibrationConfig,
    MonitorConfig,
    ObjectiveConfig,
    PolicyConfig,
    WindowConfig,
    load_config,
)
from coec.geometry.se3 import inverse, rotation_angle_rad
from coec.schemas.keys import Keys
from coec.simulation.drive import SimulatedDrive
from coec.sources import Recording, open_source
from e2e.processes import Service, service, write_configuration
from fakes import wait_until

pytest.importorskip("embreex", reason="needs the optional extra `sim`")

SECONDS, STEP_S, RATE_HZ = 100, 40, 1.0
SOURCE = f"sim:seed=1&seconds={SECONDS}&camera=pinhole480x240&lidar=32&camera_hz={RATE_HZ}&lidar_hz={RATE_HZ}&depth=yes"
STEP = f"&faults=step:{STEP_S}:ry=1"
"""One degree in yaw, when one window and several looks have passed."""

NOTICED_S = 60.0
"""Of driving."""

LOOK_S = 5.0
PATIENCE_S = 120.0
MAX_ERROR_DEG = 0.35

Frame = CameraFrame | LidarFrame | EgoMotion


@cache
def drive() -> tuple[Recording, tuple[Frame, ...]]:
    """The recording and its frames, drawn once for all tests."""
    recording = open_source(SOURCE + STEP)
    return recording, tuple(recording.messages())


def configured(folder: Path, policy: PolicyConfig) -> Path:
    calibration = CalibrationConfig(objective=ObjectiveConfig(kind="mi"))
    path = write_configuration(folder, SOURCE, np.zeros(6), calibration)
    config = load_config(path)
    pair = config.pairs[0].model_copy(
        update={
            "window": WindowConfig(pairs=16, min_pairs=8, slice_s=32.0),
            "monitor": MonitorConfig(period_s=LOOK_S, pairs=5, min_pairs=4, urgent_slice_s=16.0),
            "policy": policy,
        }
    )
    path.write_text(commented_yaml(config.model_copy(update={"pairs": (pair,)})))
    return path


@dataclass
class Ride:
    """A client that drives, and writes down what the service says."""

    running: Service
    session: zenoh.Session
    keys: Keys
    pair: str
    states: list[tuple[int, str]]
    paced: threading.Event = field(default_factory=threading.Event)
    """Never set: the sender's pace, so that the bounded inbox of the service loses nothing."""

    def ask(self, key: str, parameters: str = "", payload: bytes | None = None) -> Any:
        reply = ask_one(self.session, f"{key}?format=json{parameters}", 10.0, payload)
        return json.loads(reply.payload)

    def health(self) -> Any:
        return self.ask(self.keys.health(self.pair))

    def extrinsic(self) -> Any:
        return self.ask(self.keys.extrinsic(self.pair))

    def command(self, name: str, payload: bytes | None = None) -> Any:
        return self.ask(self.keys.command(self.pair, name), "", payload)

    def done(self) -> bool:
        """Nothing waits and nothing is under way."""
        status = self.ask(self.keys.status)
        return bool(status["worker"]["state"] == "idle" and status["worker"]["queued"] == 0)

    def play(self, begin_s: float, end_s: float) -> None:
        """A part of the drive, a look's worth at a time, waiting until the service has digested it."""
        start_ns = drive()[0].camera_stamps_ns[0]
        period = None
        for frame in drive()[1]:
            if not begin_s <= (frame.stamp_ns - start_ns) / 1e9 + 0.5 / RATE_HZ < end_s:
                continue
            now = frame.stamp_ns // round(LOOK_S * 1e9)
            if period is not None and now != period:
                self.digest()
            period = now
            name, payload = encoded(frame)
            self.session.put(f"sensors/{self.pair}/{name}", payload, encoding=MSGPACK)
            self.paced.wait(0.002 if name == "ego" else 0.01)
        self.digest()

    def digest(self) -> None:
        quiet = 0
        deadline_s = time.monotonic() + PATIENCE_S
        while quiet < 3:
            assert time.monotonic() < deadline_s, "the service does not come to rest"
            quiet = quiet + 1 if self.done() else 0
            time.sleep(0.03)
        health = self.health()
        if not self.states or self.states[-1][1] != health["state"]:
            self.states.append((health["evaluated_ns"], health["state"]))


@contextmanager
def riding(config: Path) -> Iterator[Ride]:
    loaded = load_config(config)
    with service(config) as running, connected(loaded.zenoh.connect, 30.0) as session:
        yield Ride(running, session, Keys(loaded.prefix, loaded.vehicle), loaded.pairs[0].name, [])
        assert running.terminate() == 0


def encoded(frame: Frame) -> tuple[str, bytes]:
    match frame:
        case CameraFrame():
            return "camera", encode_camera(frame)
        case LidarFrame():
            return "lidar", encode_lidar(frame)
        case EgoMotion():
            return "ego", encode_ego(frame)


def error_deg(extrinsic: Any, second: float) -> float:
    """Against the truth at this time of the drive."""
    recording = drive()[0]
    assert isinstance(recording, SimulatedDrive)
    right = recording.truth(recording.camera_stamps_ns[0] + round(second * 1e9))
    served = np.array(extrinsic["camera_from_lidar"]["matrix"])
    return float(np.degrees(rotation_angle_rad(served @ inverse(right))))


def test_a_step_is_noticed_corrected_and_remembered(tmp_path: Path) -> None:
    config = configured(tmp_path, PolicyConfig())
    with riding(config) as ride:
        ride.play(0, STEP_S)
        before = ride.extrinsic()
        assert ride.health()["state"] == "healthy"
        assert error_deg(before, 0) < MAX_ERROR_DEG
        ride.play(STEP_S, SECONDS + 1)
        step_ns = drive()[0].camera_stamps_ns[0] + STEP_S * 1_000_000_000
        red_ns = next(stamp for stamp, state in ride.states if state == "miscalibrated")
        assert 0 < (red_ns - step_ns) / 1e9 < NOTICED_S
        assert [state for _, state in ride.states][-1] == "healthy"
        after = ride.extrinsic()
        assert error_deg(after, SECONDS) < MAX_ERROR_DEG

        (event,) = ride.ask(ride.keys.evidence(ride.pair))["events"]
        assert event["resolution"].startswith("healthy")
        assert {event["window_before"], event["window_after"]} <= {
            item["window_id"] for item in ride.ask(ride.keys.windows(ride.pair))["windows"]
        }
        assert event["overlays"] == ["before", "after"]
        whole = ride.ask(ride.keys.evidence_of(ride.pair, event["event_id"]))
        assert len(whole["metrics"]) > 5
        picture = ask_one(
            ride.session, f"{ride.keys.evidence_of(ride.pair, event['event_id'])}?overlay=after", 10.0
        ).payload
        assert picture[:3] == b"\xff\xd8\xff"
        for parameters in ("", "?at=nominal", f"?window={event['window_before']}"):
            drawn = ask_one(ride.session, f"{ride.keys.overlay(ride.pair)}{parameters}", 20.0)
            assert drawn.encoding == "image/jpeg"
            assert drawn.payload[:3] == b"\xff\xd8\xff"

        back = ride.command("rollback")
        assert back["code"] == "rolled_back"
        assert ride.extrinsic()["camera_from_lidar"] == before["camera_from_lidar"]
        assert ride.health()["state"] == "unknown"
        assert ride.command("hold")["code"] == "held"
        assert ride.command("reset")["code"] == "held"
        states = ride.ask(ride.keys.history(ride.pair))["entries"]

    with riding(config) as ride:
        again = ride.extrinsic()
        assert again["camera_from_lidar"] == before["camera_from_lidar"]
        assert (again["provenance"], again["held"]) == ("restored", True)
        assert ride.ask(ride.keys.history(ride.pair))["entries"] == states
        assert ride.command("hold", b'{"release":true}')["code"] == "released"
        assert ride.command("reset")["code"] == "reset"
        assert ride.extrinsic()["provenance"] == "nominal"


def test_with_never_the_candidate_waits_and_nothing_else_changes(tmp_path: Path) -> None:
    with riding(configured(tmp_path, PolicyConfig(apply="never"))) as ride:
        ride.play(0, STEP_S)
        before = ride.extrinsic()
        assert before["provenance"] == "nominal"
        assert ride.health()["state"] == "healthy", "a window agrees with nominal"
        ride.play(STEP_S, SECONDS + 1)
        after = ride.extrinsic()
        assert after["camera_from_lidar"] == before["camera_from_lidar"]
        assert after["provenance"] == "nominal"
        assert ride.health()["state"] == "miscalibrated"
        assert after["pending"] is not None
        assert error_deg(after["pending"], SECONDS) < MAX_ERROR_DEG
        assert ride.command("apply")["code"] == "applied"
        applied = ride.extrinsic()
        assert applied["camera_from_lidar"] == after["pending"]["camera_from_lidar"]
        assert (applied["provenance"], applied["pending"]) == ("estimated", None)
        wait_until(lambda: ride.health()["state"] == "healthy", "health after the command")
