"""The sensors of the benchmark, in a process that runs until its standard input ends: cameras, LiDARs and ego-motion at
the rates of a vehicle, as native frames or as sent by nodes of ROS 2.
"""

import itertools
import select
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import zenoh

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.geometry.cameras import Camera
from coec.io.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.io.ros import message_encoding, messages
from coec.io.ros.wire_format import SENSOR_DATA, Node, RmwZenoh
from coec.io.zenoh.query_client import connected
from coec.io.zenoh.ros_node import RosNode, RosPublishers
from coec_lab.bench import scene

Frame = CameraFrame | LidarFrame | EgoMotion


@dataclass(frozen=True, slots=True)
class Load:
    """What is sent.

    Attributes:
        cameras, lidars: how many.
        camera_hz: images a second of each camera.
        sweep_every: each LiDAR has one sweep per so many images of a camera.
        side_px: of the images.
        is_ros: whether sensors are nodes of ROS.
    """

    cameras: int = 1
    lidars: int = 1
    camera_hz: float = 30.0
    sweep_every: int = 3
    side_px: int = scene.IMAGE_PX
    is_ros: bool = False

    @property
    def pairs(self) -> tuple[str, ...]:
        """Names of the pairs: every camera with every LiDAR."""
        return tuple(f"{camera}-{lidar}" for camera in range(self.cameras) for lidar in range(self.lidars))

    @property
    def camera(self) -> Camera:
        """Model of every camera."""
        return scene.camera_of(CAMERA, self.side_px)


LOADS: Mapping[str, Load] = {
    "native": Load(),
    "ros": Load(is_ros=True),
    "rig": Load(cameras=4, camera_hz=10.0, sweep_every=1),
    "large_rig": Load(cameras=8, lidars=3, camera_hz=10.0, sweep_every=1, side_px=700),
}
"""Loads by name. A rig has four fisheyes and a LiDAR; a large one has eight and three, with pictures of half the
width."""

ROOMS = 7
"""Different frames that are sent in turn, because a camera that repeats one picture would look frozen."""

CAMERA = "double_sphere"
CONNECT_S = 60.0
SPEED_MPS = 10.0
TOPICS = {"camera": "/bench/camera/compressed", "lidar": "/bench/points", "ego": "/bench/odometry"}
"""Topics of the only pair in the load of ROS."""


def key(kind: str, index: int = 0) -> str:
    """Key of the native frames of the camera, the LiDAR or the ego-motion of this number."""
    return f"bench/{kind}-{index}"


def main(endpoint: str, name: str, pace: str = "1") -> int:
    """Publishes until standard input ends; always returns 0. `name` is one of `LOADS`; `pace` is the seconds of driving
    in a second."""
    load = LOADS[name]
    pairs = [scene.pair(load.camera, seed, 0) for seed in range(ROOMS)]
    with connected([endpoint], CONNECT_S) as session:
        send = (_ros if load.is_ros else _native)(session, load)
        begin_s, begin_ns = time.monotonic(), time.time_ns()
        for count in itertools.count():
            drive_s = count / load.camera_hz
            if _input_closed(begin_s + drive_s / float(pace) - time.monotonic()):
                return 0
            stamp_ns = begin_ns + round(1e9 * drive_s)
            send(EgoMotion(stamp_ns, "ego", (SPEED_MPS, 0.0, 0.0), (0.0, 0.0, 0.0), count), 0)
            room = pairs[count % ROOMS]
            for index in range(load.cameras):
                send(replace(room.camera, stamp_ns=stamp_ns, sequence=count), index)
            for index in range(load.lidars if count % load.sweep_every == 0 else 0):
                send(replace(room.lidar, stamp_ns=stamp_ns, sequence=count // load.sweep_every), index)
    return 0


Send = Callable[[Frame, int], None]
"""Sends a frame of the sensor of this number."""


def _native(session: zenoh.Session, load: Load) -> Send:
    """Sends native frames on their keys."""
    encoding = zenoh.Encoding("application/msgpack")
    many = {"camera": load.cameras, "lidar": load.lidars, "ego": 1}
    streams = {
        kind: [session.declare_publisher(key(kind, index), encoding=encoding) for index in range(count)]
        for kind, count in many.items()
    }

    def send(frame: Frame, index: int) -> None:
        match frame:
            case CameraFrame():
                streams["camera"][index].put(encode_camera(frame))
            case LidarFrame():
                streams["lidar"][index].put(encode_lidar(frame))
            case EgoMotion():
                streams["ego"][index].put(encode_ego(frame))

    return send


def _ros(session: zenoh.Session, load: Load) -> Send:
    """Sends CDR on `TOPICS`, as nodes of rmw_zenoh do."""
    del load
    node = RosNode(session, RmwZenoh(Node(0, str(session.info.zid()), 0, "/bench", "sensors"), messages.type_hash))
    publishers = RosPublishers(session, node)
    types = {"camera": messages.COMPRESSED_IMAGE, "lidar": messages.POINT_CLOUD, "ego": messages.ODOMETRY}
    streams = {name: publishers.publisher(TOPICS[name], of_type, SENSOR_DATA) for name, of_type in types.items()}

    def send(frame: Frame, index: int) -> None:
        del index
        match frame:
            case CameraFrame():
                streams["camera"].put(message_encoding.encode_image(frame)[1], frame.stamp_ns)
            case LidarFrame():
                streams["lidar"].put(message_encoding.encode_cloud(frame), frame.stamp_ns)
            case EgoMotion():
                streams["ego"].put(message_encoding.encode_motion(frame)[1], frame.stamp_ns)

    return send


def _input_closed(wait_s: float) -> bool:
    """Whether standard input ends within so many seconds."""
    readable, _, _ = select.select([sys.stdin], [], [], max(wait_s, 0.0))
    return bool(readable) and not sys.stdin.buffer.read(1)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
