"""A vehicle of ROS 2 on rmw_zenoh, imitated: keys, tokens and attachments as they were seen on the wire, written down
here and made by nothing of ours; messages by `rosbags`."""

from __future__ import annotations

import hashlib
import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_humble as ros
from zenoh.ext import AdvancedPublisher, CacheConfig, MissDetectionConfig, declare_advanced_publisher

from coec.calibration.types import CameraFrame, EgoMotion, Frame, LidarFrame
from coec.geometry import cameras
from coec.io.ros import message_encoding
from support.recordings import transform_message

STORE = get_typestore(Stores.ROS2_HUMBLE)

CAMERA = "/sensing/camera/front/image_raw/compressed"
POINTS = "/sensing/lidar/top/points"
EGO = "/localization/odometry"
INFO = "/sensing/camera/front/camera_info"
TF = "/tf_static"

TYPES = {
    CAMERA: "sensor_msgs::msg::dds_::CompressedImage_/"
    "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    POINTS: "sensor_msgs::msg::dds_::PointCloud2_/"
    "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    EGO: "nav_msgs::msg::dds_::Odometry_/RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    INFO: "sensor_msgs::msg::dds_::CameraInfo_/RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    TF: "tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
"""Type and hash of each topic, as they stand in its key."""

CONFIGURATION = """vehicle: shuttle-7
zenoh: {{connect: [{endpoint}]}}
middleware: rmw_zenoh
pairs:
  - name: front
    camera: /sensing/camera/front/image_raw/compressed
    points: /sensing/lidar/top/points
    ego: /localization/odometry
"""
"""Eight lines: all that a vehicle needs."""


def configured(folder: Path, endpoint: str, more: str = "") -> Path:
    """The eight lines in a file, and after them whatever the test adds."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "coec.yaml"
    path.write_text(CONFIGURATION.format(endpoint=endpoint) + more)
    return path


BLOCK = zenoh.CongestionControl.BLOCK
"""Whoever sends waits for the network: by default Zenoh drops after a millisecond, which a busy machine often takes."""


class Vehicle:
    """Publishes on a session of its own. Latched messages wait for whoever comes later."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._sequence: Counter[str] = Counter()
        self._latched: dict[str, AdvancedPublisher] = {}
        zid = str(session.info.zid())
        self._tokens = [
            session.liveliness().declare_token(
                f"@ros2_lv/0/{zid}/0/{number}/MP/%/%/driver/{topic.replace('/', '%')}/{kind}/2::,5:,:,:,,"
            )
            for number, (topic, kind) in enumerate(TYPES.items(), start=1)
        ]

    def put(self, topic: str, payload: bytes) -> None:
        """A message of a topic that keeps nothing."""
        self._session.put(
            f"0{topic}/{TYPES[topic]}", payload, congestion_control=BLOCK, attachment=self._attachment(topic)
        )

    def latch(self, topic: str, payload: bytes) -> None:
        """A message that is kept for whoever comes later."""
        if topic not in self._latched:
            self._latched[topic] = latched(self._session, f"0{topic}/{TYPES[topic]}")
        self._latched[topic].put(payload, attachment=self._attachment(topic))

    def send(self, frame: Frame) -> None:
        """A frame as drivers send it: without depth, numbered by its attachment."""
        self.put(*message_of(frame))

    def close(self) -> None:
        """Be gone, with what was kept."""
        for publisher in self._latched.values():
            publisher.undeclare()
        for token in self._tokens:
            token.undeclare()

    def _attachment(self, topic: str) -> bytes:
        self._sequence[topic] += 1
        gid = hashlib.sha256(topic.encode()).digest()[:16]
        return struct.pack("<qqB16s", self._sequence[topic], 1_700_000_000_000_000_000, 16, gid)


def latched(session: zenoh.Session, key: str) -> AdvancedPublisher:
    """A publisher that keeps its last message for whoever comes later, as rmw_zenoh and the bridge declare it."""
    return declare_advanced_publisher(
        session,
        key,
        cache=CacheConfig(1),
        sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
        publisher_detection=True,
    )


def message_of(frame: Frame) -> tuple[str, bytes]:
    """The topic of a frame, and its message."""
    match frame:
        case CameraFrame():
            return CAMERA, message_encoding.encode_image(frame)[1]
        case LidarFrame():
            return POINTS, message_encoding.encode_cloud(frame)
        case EgoMotion():
            return EGO, message_encoding.encode_motion(replace(frame, frame_id="base_link"))[1]


def camera_info(camera: cameras.Camera, frame_id: str) -> bytes:
    """Of a pinhole, by `rosbags`."""
    header = ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(5, 6), frame_id)
    k = np.array([camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0])
    roi = ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, False)
    message: Any = ros.sensor_msgs__msg__CameraInfo(
        header, camera.height, camera.width, "plumb_bob", np.zeros(5), k, np.eye(3).reshape(-1), np.zeros(12), 0, 0, roi
    )
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/CameraInfo"))


def transforms(*joints: tuple[str, str, NDArray[np.float64]]) -> bytes:
    """Parent, child and the child's pose, by `rosbags`."""
    message = ros.tf2_msgs__msg__TFMessage([transform_message(*joint) for joint in joints])
    return bytes(STORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage"))
