"""Sensor drivers of a vehicle that speaks ROS 2, without ROS: keys, tokens and what lies beside a message are put
together here by hand, as they were on the wire between rmw_zenoh_cpp 0.6.7 and a session."""

from __future__ import annotations

import struct
import time
from collections import Counter
from collections.abc import Mapping

import xxhash
import zenoh

from coec.adapters.ros import outgoing
from coec.adapters.zenoh.matching import has_subscribers
from coec.adapters.zenoh.player import Frame, stream_of
from coec.calibration.types import CameraFrame, LidarFrame
from fakes import wait_until

HASHES = {
    "CompressedImage": "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    "Image": "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "PointCloud2": "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "Odometry": "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
}
"""Of the types, as rclpy of Kilted gives them."""

PACKAGES = {"Odometry": "nav_msgs"}
TYPES = {"camera": "CompressedImage", "lidar": "PointCloud2", "ego": "Odometry"}


def cdr_message(frame: Frame) -> bytes:
    """The message that holds a frame."""
    match frame:
        case CameraFrame():
            return outgoing.encode_image(frame)[1]
        case LidarFrame():
            return outgoing.encode_cloud(frame)
        case _:
            return outgoing.encode_motion(frame)[1]


def type_chunks(type_name: str) -> str:
    """The last two chunks of a key."""
    return f"{PACKAGES.get(type_name, 'sensor_msgs')}::msg::dds_::{type_name}_/{HASHES[type_name]}"


class RosDriver:
    """One publisher of rmw_zenoh; a node of its own. `number` tells those of a session apart."""

    def __init__(self, session: zenoh.Session, topic: str, type_name: str, number: int, node: str = "driver") -> None:
        zid, mangled = session.info.zid(), topic.replace("/", "%")
        token = f"@ros2_lv/0/{zid}/{number}/{number + 1}/MP/%/%/{node}/{mangled}/{type_chunks(type_name)}/2::,5:,:,:,,"
        self.gid = xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
        self.publisher = session.declare_publisher(
            f"0{topic}/{type_chunks(type_name)}", congestion_control=zenoh.CongestionControl.BLOCK
        )
        self._token = session.liveliness().declare_token(token)
        self._sequence = 0

    def put(self, payload: bytes, number: int | None = None) -> None:
        """`number` instead of the next one."""
        self._sequence = self._sequence + 1 if number is None else number
        attachment = struct.pack("<qqB16s", self._sequence, time.time_ns(), 16, self.gid)
        self.publisher.put(payload, attachment=attachment)

    def sends(self, payload: bytes) -> bool:
        """Puts it; False, for a loop that waits for what comes of it."""
        self.put(payload)
        return False

    def close(self) -> None:
        self._token.undeclare()
        self.publisher.undeclare()


class BridgedTopic:
    """One topic of DDS behind a zenoh-bridge-ros2dds."""

    def __init__(self, session: zenoh.Session, topic: str) -> None:
        self.publisher = session.declare_publisher(topic[1:], congestion_control=zenoh.CongestionControl.BLOCK)

    def put(self, payload: bytes) -> None:
        self.publisher.put(payload)

    def close(self) -> None:
        self.publisher.undeclare()


class RosSensors:
    """Camera, LiDAR and ego-motion of a pair, on these topics."""

    def __init__(self, session: zenoh.Session, topics: Mapping[str, str], middleware: str) -> None:
        self.sent: Counter[str] = Counter()
        self._drivers: dict[str, RosDriver | BridgedTopic] = {
            stream: RosDriver(session, topic, TYPES[stream], 10 * number)
            if middleware == "rmw_zenoh"
            else BridgedTopic(session, topic)
            for number, (stream, topic) in enumerate(topics.items())
        }
        wait_until(lambda: all(has_subscribers(one.publisher) for one in self._drivers.values()), "somebody listens")

    def send(self, frame: Frame) -> None:
        self._drivers[stream_of(frame)].put(cdr_message(frame))
        self.sent[stream_of(frame)] += 1

    def close(self) -> None:
        for driver in self._drivers.values():
            driver.close()
