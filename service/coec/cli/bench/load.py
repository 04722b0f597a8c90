"""The sensors of the benchmark, in a process of their own, until its standard input ends: camera, LiDAR and ego-motion
of one pair at the rates of a vehicle, as native frames or as nodes of ROS 2 send them.
"""

from __future__ import annotations

import itertools
import select
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import zenoh

from coec.adapters.frames.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.adapters.ros import messages, outgoing
from coec.adapters.ros.wire.qos import SENSOR_DATA
from coec.adapters.ros.wire.rmw_zenoh import Node, RmwZenoh
from coec.adapters.zenoh.client import connected
from coec.adapters.zenoh.ros_publisher import RosNode, RosPublishers
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.cli.bench import scene

Frame = CameraFrame | LidarFrame | EgoMotion

CAMERA_HZ, SWEEP_EVERY = 30.0, 3
"""Images a second of one camera, and of how many images each has a sweep: 10 sweeps a second."""

RIG = ("front", "left", "rear", "right")
"""Cameras of a vehicle that sees all around: each as often as there are sweeps, all at a time."""

ROOMS = 7
"""Different frames that are sent in turn: a camera that sends one and the same would look frozen."""

CAMERA = "double_sphere"
CONNECT_S = 60.0
SPEED_MPS = 10.0
TOPICS = {"camera": "/bench/camera/compressed", "lidar": "/bench/points", "ego": "/bench/odometry"}
KEYS = {"camera": "bench/camera", "lidar": "bench/lidar", "ego": "bench/ego"}


@dataclass(frozen=True, slots=True)
class Sensors:
    """A set of sensors: what sends a frame of theirs, how often there are images, of how many each has a sweep."""

    sender: Callable[[zenoh.Session], Callable[[Frame], None]]
    camera_hz: float
    sweep_every: int


def main(endpoint: str, form: str, pace: str = "1") -> int:
    """Publishes until standard input ends; always 0. `form` is one of `FORMS`; `pace`: seconds of driving in a second,
    by which stamps and frames come."""
    sensors = FORMS[form]
    pairs = [scene.pair(scene.CAMERAS[CAMERA], seed, 0) for seed in range(ROOMS)]
    with connected([endpoint], CONNECT_S) as session:
        send = sensors.sender(session)
        begin_s, begin_ns = time.monotonic(), time.time_ns()
        for count in itertools.count():
            drive_s = count / sensors.camera_hz
            if _ended(begin_s + drive_s / float(pace) - time.monotonic()):
                return 0
            room, stamp_ns = pairs[count % ROOMS], begin_ns + round(1e9 * drive_s)
            send(EgoMotion(stamp_ns, "ego", (SPEED_MPS, 0.0, 0.0), (0.0, 0.0, 0.0), count))
            send(replace(room.camera, stamp_ns=stamp_ns, sequence=count))
            if count % sensors.sweep_every == 0:
                send(replace(room.lidar, stamp_ns=stamp_ns, sequence=count // sensors.sweep_every))
    return 0


def camera_key(name: str) -> str:
    """Of a camera of `RIG`."""
    return f"{KEYS['camera']}/{name}"


def _native(session: zenoh.Session) -> Callable[[Frame], None]:
    """Native frames on `KEYS`."""
    return _on_keys(session, (KEYS["camera"],))


def _rig(session: zenoh.Session) -> Callable[[Frame], None]:
    """The same with the images on the key of every camera of `RIG`."""
    return _on_keys(session, [camera_key(name) for name in RIG])


def _on_keys(session: zenoh.Session, cameras: Sequence[str]) -> Callable[[Frame], None]:
    encoding = zenoh.Encoding("application/msgpack")
    streams = {name: session.declare_publisher(KEYS[name], encoding=encoding) for name in ("lidar", "ego")}
    images = [session.declare_publisher(key, encoding=encoding) for key in cameras]

    def send(frame: Frame) -> None:
        match frame:
            case CameraFrame():
                for stream in images:
                    stream.put(encode_camera(frame))
            case LidarFrame():
                streams["lidar"].put(encode_lidar(frame))
            case EgoMotion():
                streams["ego"].put(encode_ego(frame))

    return send


def _ros(session: zenoh.Session) -> Callable[[Frame], None]:
    """CDR on `TOPICS`, as nodes of rmw_zenoh publish it."""
    node = RosNode(session, RmwZenoh(Node(0, str(session.info.zid()), 0, "/bench", "sensors"), messages.type_hash))
    publishers = RosPublishers(session, node)
    types = {"camera": messages.COMPRESSED_IMAGE, "lidar": messages.POINT_CLOUD, "ego": messages.ODOMETRY}
    streams = {name: publishers.publisher(TOPICS[name], of_type, SENSOR_DATA) for name, of_type in types.items()}

    def send(frame: Frame) -> None:
        match frame:
            case CameraFrame():
                streams["camera"].put(outgoing.encode_image(frame)[1], frame.stamp_ns)
            case LidarFrame():
                streams["lidar"].put(outgoing.encode_cloud(frame), frame.stamp_ns)
            case EgoMotion():
                streams["ego"].put(outgoing.encode_motion(frame)[1], frame.stamp_ns)

    return send


FORMS: Mapping[str, Sensors] = {
    "native": Sensors(_native, CAMERA_HZ, SWEEP_EVERY),
    "ros": Sensors(_ros, CAMERA_HZ, SWEEP_EVERY),
    "rig": Sensors(_rig, CAMERA_HZ / SWEEP_EVERY, 1),
}
"""Sensors of one pair that send native frames or are nodes of ROS, and those of a rig."""


def _ended(wait_s: float) -> bool:
    """Whether standard input ends within so many seconds."""
    readable, _, _ = select.select([sys.stdin], [], [], max(wait_s, 0.0))
    return bool(readable) and not sys.stdin.buffer.read(1)
