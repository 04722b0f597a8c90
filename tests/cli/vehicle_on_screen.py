"""A vehicle for `coec view`: a service that answers what it is told to, and sensors that send whether somebody listens
or not."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import zenoh

from coec.config import Config
from coec.geometry import se3
from coec.io.msgpack_frames import encode_camera, encode_lidar
from coec.io.rig_files import intrinsics_config
from coec.io.serialise import transform_of
from coec.io.zenoh.bus import MSGPACK
from coec.io.zenoh.ros_node import has_subscribers
from coec.reports.commented_yaml import commented_yaml
from coec.schemas.keys import Keys
from coec.schemas.message import to_msgpack
from coec.schemas.replies import (
    ROS_LEVELS,
    Axes,
    AxisReply,
    Candidate,
    DataQuality,
    ExtrinsicReply,
    HealthReply,
    HealthState,
    Reason,
)
from support.scenes import BOARD_LENSES, BOARD_MOVED, BOARD_NOMINAL, board_frame_pair, board_rig

RIG = board_rig(BOARD_LENSES["double_sphere"])
PAIR = board_frame_pair(RIG.camera)
PAIR = replace(PAIR, lidar=replace(PAIR.lidar, xyz_m=PAIR.lidar.xyz_m[::16], ring=None))
KEYS = Keys("coec", "vehicle")
CANDIDATE = se3.perturb(BOARD_NOMINAL, np.radians([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
PERIOD_S = 0.05


class Service:
    """Answers and publishes as a service does, of one pair."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._reported = {KEYS.health("front"): health("healthy"), KEYS.extrinsic("front"): extrinsic(BOARD_MOVED)}
        self._queryables = [session.declare_queryable(key, self._answer) for key in self._reported]
        self._token = session.liveliness().declare_token(KEYS.alive("front"))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            key = str(query.key_expr)
            query.reply(key, self._reported[key], encoding=MSGPACK)

    def say(self, key: str, document: bytes) -> None:
        """From now on."""
        self._reported[key] = document
        self._session.put(key, document, encoding=MSGPACK)

    def end(self) -> None:
        for queryable in self._queryables:
            queryable.undeclare()
        self._token.undeclare()


AXIS = AxisReply(status="accepted", sigma=0.05, correction=2.0, unit="deg")
AXES = Axes(rx=AXIS, ry=AXIS, rz=AXIS, tx=AXIS, ty=AXIS, tz=AXIS)


def health(state: HealthState) -> bytes:
    why = (Reason(code="moved", text="It has moved."),) if state == "miscalibrated" else ()
    reply = HealthReply(
        vehicle="vehicle", pair="front", state=state, level=ROS_LEVELS[state], reasons=why, metrics={}, axes=AXES,
        needs=(), data_quality=DataQuality(), since_ns=0, evaluated_ns=None, age_s=None,
    )  # fmt: skip
    return to_msgpack(reply)


def extrinsic(T_camera_lidar: np.ndarray) -> bytes:
    waits = Candidate(window_id="front-7", data_stamp_ns=7, camera_from_lidar=transform_of(CANDIDATE))
    reply = ExtrinsicReply(
        vehicle="vehicle", pair="front", camera_frame="cam", lidar_frame="velo", provenance="estimated",
        camera_from_lidar=transform_of(T_camera_lidar), status="accepted", percent_complete=40.0, axes=AXES,
        valid_from_ns=0, data_stamp_ns=None, window_id=None, config_hash="0", pending=waits,
    )  # fmt: skip
    return to_msgpack(reply)


def configuration(folder: Path, endpoint: str) -> Path:
    pair = {
        "name": "front",
        "camera": {"key": "in/camera", "frame_id": "cam", "intrinsics": intrinsics_config(RIG.camera).model_dump()},
        "lidar": {"key": "in/lidar", "frame_id": "velo"},
        "T_camera_lidar": BOARD_NOMINAL.tolist(),
    }
    zenoh_config = {"connect": [endpoint], "listen": [endpoint]}
    path = folder / "coec.yaml"
    path.write_text(commented_yaml(Config.model_validate({"zenoh": zenoh_config, "pairs": [pair]})))
    return path


class Sensors:
    """A camera and a LiDAR that send, whether somebody listens or not."""

    def __init__(self, session: zenoh.Session) -> None:
        self._publishers = {stream: session.declare_publisher(f"in/{stream}") for stream in ("camera", "lidar")}
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._send)

    def __enter__(self) -> Sensors:
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._end.set()
        self._thread.join()
        for publisher in self._publishers.values():
            publisher.undeclare()

    @property
    def are_received(self) -> bool:
        return any(has_subscribers(publisher) for publisher in self._publishers.values())

    def _send(self) -> None:
        number = 0
        while not self._end.wait(PERIOD_S):
            number += 1
            stamp_ns = 10**18 + round(number * PERIOD_S * 1e9)
            camera, lidar = replace(PAIR.camera, stamp_ns=stamp_ns), replace(PAIR.lidar, stamp_ns=stamp_ns)
            self._publishers["camera"].put(encode_camera(camera), encoding=MSGPACK)
            self._publishers["lidar"].put(encode_lidar(lidar), encoding=MSGPACK)
