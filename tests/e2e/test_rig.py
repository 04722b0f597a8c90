"""A rig of four cameras and a LiDAR in a running service: its LiDAR is knocked, which is said and put right once."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.adapters.files.rig import mask_to_png
from coec.adapters.zenoh.player import Player, SensorKeys
from coec.cli.convert import configuration_for
from coec.config import (
    BudgetConfig,
    CalibrationConfig,
    Config,
    DepthConfig,
    MonitorConfig,
    PairConfig,
    StateConfig,
    WindowConfig,
    ZenohConfig,
)
from coec.geometry.se3 import inverse, rotation_angle_rad
from coec.schemas.base import from_json
from coec.schemas.rig_state import RigReply
from coec.simulation.rig_drive import RigDrive
from coec.simulation.source import open_rig
from coec.sources.recording import Message
from e2e.processes import PATIENCE_S, Router, Service, coec, service

pytest.importorskip("embreex", reason="needs the optional extra `sim`")

NS_PER_S = 1_000_000_000
SECONDS, KNOCK_S = 60, 26
WORDS = (
    f"rig=four-fisheyes&seed=7&seconds={SECONDS}&camera=fisheye256&camera_hz=1&lidar_hz=1&ego_hz=10&depth=yes"
    f"&faults=roof:step:{KNOCK_S}:rz=2"
)
"""The roof LiDAR turns by two degrees: at 256 pixels for 190° that is more than two of them."""


def _drive() -> RigDrive:
    return open_rig(dict(word.split("=", 1) for word in WORDS.split("&")))


def _pair(folder: Path, drive: RigDrive, camera: str) -> PairConfig:
    """A camera and the roof LiDAR, each on the key of its sensor."""
    recording = drive.pair(camera, "roof")
    mask = folder / f"{camera}.png"
    if recording.rig.mask is not None:
        mask.write_bytes(mask_to_png(recording.rig.mask))
    nominal = recording.rig.T_camera_lidar_nominal
    pair = configuration_for(recording, nominal, Path(mask.name) if recording.rig.mask is not None else None)
    ego = None if pair.ego is None else pair.ego.model_copy(update={"key": "sensors/ego"})
    return pair.model_copy(
        update={
            "name": camera,
            "camera": pair.camera.model_copy(update={"name": camera, "key": f"sensors/{camera}"}),
            "lidar": pair.lidar.model_copy(update={"name": "roof", "key": "sensors/roof"}),
            "ego": ego,
            "window": WindowConfig(pairs=12, min_pairs=6, slice_s=18.0),
            "monitor": MonitorConfig(period_s=5.0, pairs=5, min_pairs=4, urgent_slice_s=12.0),
            "calibration": CalibrationConfig(depth=DepthConfig(model="stereo")),
        }
    )


def _configuration(folder: Path, drive: RigDrive, router: Router) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    config = Config(
        budget=BudgetConfig(cores=64.0),
        zenoh=ZenohConfig(connect=(router.endpoint,), listen=(router.endpoint,)),
        state=StateConfig(directory=Path("state"), min_free_bytes=0),
        pairs=tuple(_pair(folder, drive, camera) for camera in drive.cameras),
    )
    path = folder / "coec.yaml"
    path.write_text(config.model_dump_json(exclude_unset=True))
    return path


def _rig(running: Service) -> RigReply:
    return RigReply.model_validate(running.ask(running.keys.rig))


def _send(running: Service, drive: RigDrive, frames: list[Message]) -> None:
    """All sensors, a second of driving at a time, each once the service has taken the one before."""
    player = Player(running.session, SensorKeys(("ego", *drive.lidars, *drive.cameras)), "msgpack")
    sent: Counter[str] = Counter()
    try:
        player.wait_for_listener(PATIENCE_S)
        begin_ns = frames[0].stamp_ns
        for second in range(SECONDS + 1):
            part = [
                f for f in frames if begin_ns + second * NS_PER_S <= f.stamp_ns < begin_ns + (second + 1) * NS_PER_S
            ]
            player.play(part, 0.0, threading.Event(), lambda *_: None)
            sent.update(frame.frame_id for frame in part)

            def taken(status: Any) -> bool:
                return all(
                    pair["camera"]["received"] >= sent[pair["name"]] and pair["held"] < 8 for pair in status["pairs"]
                )

            running.until(running.status, taken, f"second {second} of the drive")
    finally:
        player.close()


def _rested(running: Service) -> None:
    """Nothing waits, and nothing is under way, for as long as it takes the rig to see that."""
    quiet_since_s = time.monotonic()
    last: Any = None
    while time.monotonic() - quiet_since_s < 8.0:
        status = running.status()
        busy = (
            status["worker"]["state"] != "idle" or status["worker"]["queued"] or any(p["held"] for p in status["pairs"])
        )
        done = [(pair["checks"], pair["solved"]) for pair in status["pairs"]]
        if busy or done != last:
            quiet_since_s, last = time.monotonic(), done
        running.changed.wait(0.5)
        running.changed.clear()


@pytest.mark.slow
@pytest.mark.fault("the LiDAR of a running vehicle is knocked", "it is named, and all pairs are put right together")
def test_a_knocked_lidar_is_named_and_put_right(
    tmp_path: Path, router: Router, record_property: Callable[[str, object], None]
) -> None:
    drive = _drive()
    frames = list(drive.messages())
    config = _configuration(tmp_path, drive, router)
    with service(config, router) as running:
        assert {sensor.state for sensor in _rig(running).sensors} == {"unknown"}
        _send(running, drive, frames)
        _rested(running)
        told = _rig(running)
        print(told.model_dump_json(indent=1))
        assert told.correction is not None
        assert told.correction.sensors == ("roof",)
        assert set(told.correction.pairs) == set(drive.cameras)
        knock_ns = frames[0].stamp_ns + KNOCK_S * NS_PER_S
        record_property("figure", f"put right {(told.correction.stamp_ns - knock_ns) / NS_PER_S:.0f} s after the knock")
        for camera in drive.cameras:
            reply = running.ask(running.keys.extrinsic(camera))
            right = drive.pair(camera, "roof").truth(frames[-1].stamp_ns)
            served = np.array(reply["camera_from_lidar"]["matrix"])
            assert np.degrees(rotation_angle_rad(served @ inverse(right))) < 0.5, camera
        shown = coec("query", "rig", "--connect", router.endpoint)
        assert shown.returncode == 0, shown.stderr
        assert "roof" in shown.stdout
        as_json = coec("query", "rig", "--connect", router.endpoint, "--json")
        assert from_json(RigReply, as_json.stdout.encode()).correction == told.correction
