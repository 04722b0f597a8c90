"""Frames of a recording or of a vehicle's sensors as messages on ROS 2 topics, the names of these topics, and recorded
messages shifted in time.

In bags that coec writes, and by default in what it plays, the topics of a pair are below `/<pair>/`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.frames.pairing import azimuth_offsets_s
from coec.calibration.types import CameraFrame, EgoMotion, Frame, LidarFrame, Matrix4, Rig
from coec.config import OpenPairConfig
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal
from coec.io.ros import message_encoding, messages
from coec.io.ros.camera_info import info_topic
from coec.io.ros.message_encoding import PlacedFrame
from coec.io.ros.point_clouds import SINCE_S, UNTIL_S, row_step_of
from coec.io.ros.wire_format import Qos
from coec.schemas.keys import TF_STATIC

LATCHED: Final = 100
"""Messages of `/tf_static` that are kept for late subscribers: as many as tf2's listeners ask for (tf2_ros/qos.hpp,
StaticListenerQoS). A recording has one from each node that published static transforms."""


@dataclass(frozen=True, slots=True)
class TopicMessage:
    """A message on a topic.

    Attributes:
        stamp_ns: when it was published; the stamp of its header may be earlier.
        data: CDR.
    """

    stamp_ns: int
    topic: str
    type_name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a recording: type, number of messages, and messages per second (0 for fewer than two)."""

    type_name: str
    count: int
    rate_hz: float = 0.0


def qos_of(topic: str) -> Qos:
    """The quality of service of a played topic: reliable, which all subscribers accept; `/tf_static` also keeps its
    messages for late subscribers."""
    return Qos(transient_local=True, depth=LATCHED) if topic == TF_STATIC else Qos()


@dataclass(frozen=True, slots=True)
class PairTopics:
    """Topics of a pair's frames; None: not published. `image_raw` is for uncompressed images, `turns` for ego-motion of
    which only the rotation is known."""

    image: str
    image_raw: str
    info: str
    points: str
    motion: str | None
    turns: str | None

    @classmethod
    def default(cls, pair: str) -> PairTopics:
        """The topics below `/<pair>/`."""
        image = f"/{pair}/camera/image"
        points, motion, turns = f"/{pair}/lidar/points", f"/{pair}/odometry", f"/{pair}/imu"
        return cls(f"{image}/compressed", image, f"/{pair}/camera/camera_info", points, motion, turns)

    @classmethod
    def of_pair(cls, pair: OpenPairConfig) -> PairTopics:
        """The topics in a configuration; the camera info is where a service looks for it."""
        image = pair.camera.place
        info = pair.camera.info_topic or info_topic(image)
        motion = pair.ego.place if pair.ego else None
        return cls(image, image, info, pair.lidar.place, motion, motion)


class FrameTopics:
    """The frames of a recording as messages, with the camera info of each image, and `/tf_static` before the first."""

    def __init__(self, rig: Rig, T_camera_lidar: Matrix4, topics: PairTopics) -> None:
        """`T_camera_lidar` (4, 4) is the transform in `/tf_static`."""
        self._rig = rig
        self._T_camera_lidar = T_camera_lidar
        self._topics = topics
        self._joined: set[str] = set()

    def of(self, frame: Frame) -> Iterator[TopicMessage]:
        """The messages of the next frame; depth maps are left out."""
        for child, joint in self._joints(frame):
            if child not in self._joined:
                self._joined.add(child)
                yield TopicMessage(frame.stamp_ns, TF_STATIC, messages.TF, joint)
        for topic, type_name, data in self._messages(frame):
            yield TopicMessage(frame.stamp_ns, topic, type_name, data)

    def _joints(self, frame: Frame) -> list[tuple[str, bytes]]:
        """The static transforms that a frame needs, by the name of their child."""
        rig = self._rig
        joints = [(rig.lidar_frame, message_encoding.encode_tf_static(rig, self._T_camera_lidar, frame.stamp_ns))]
        if isinstance(frame, EgoMotion) and frame.frame_id != rig.lidar_frame:
            # The ego frame as a child of the LiDAR's frame; this transform, too, maps child to parent.
            below = replace(rig, camera_frame=rig.lidar_frame, lidar_frame=frame.frame_id)
            joints.append((frame.frame_id, message_encoding.encode_tf_static(below, rig.T_lidar_ego, frame.stamp_ns)))
        return joints

    def _messages(self, frame: Frame) -> list[tuple[str, str, bytes]]:
        topics = self._topics
        match frame:
            case CameraFrame():
                type_name, data = message_encoding.encode_image(frame)
                image = topics.image if type_name == messages.COMPRESSED_IMAGE else topics.image_raw
                info = message_encoding.encode_camera_info(self._rig, frame.stamp_ns)
                return [(topics.info, messages.CAMERA_INFO, info), (image, type_name, data)]
            case LidarFrame():
                return [(topics.points, messages.POINT_CLOUD, message_encoding.encode_cloud(_timed(self._rig, frame)))]
            case EgoMotion():
                type_name, data = message_encoding.encode_motion(frame)
                topic = topics.turns if type_name == messages.IMU else topics.motion
                return [] if topic is None else [(topic, type_name, data)]


def _timed(rig: Rig, sweep: LidarFrame) -> LidarFrame:
    """The sweep with the time of each point, because messages have no other place for the rig's sweep timing."""
    if sweep.time_offset_s is not None or rig.sweep is None:
        return sweep
    return replace(sweep, time_offset_s=azimuth_offsets_s(sweep.xyz_m, rig.sweep).astype(np.float32))


ODOMETRY = "/odometry"


@dataclass(frozen=True, slots=True)
class VehicleSensors:
    """What the messages tell about a vehicle beside its frames.

    Attributes:
        cameras: a rig with the intrinsics of each camera, by the camera's frame id.
        placed: pose of each sensor in the vehicle.
    """

    cameras: Mapping[str, Rig]
    placed: Sequence[PlacedFrame]


def image_topic(camera: str) -> str:
    """Topic of the compressed images of a camera."""
    return f"/{camera}/image/compressed"


def points_topic(lidar: str) -> str:
    """Topic of the sweeps of a LiDAR."""
    return f"/{lidar}/points"


class SensorTopics:
    """Frames as messages, on topics named after their sensors, with `/tf_static` before the first."""

    def __init__(self, vehicle: VehicleSensors) -> None:
        self._vehicle = vehicle
        self._is_joined = False

    def of(self, frame: Frame) -> Iterator[TopicMessage]:
        """The messages of the next frame; depth maps are left out."""
        stamp_ns = frame.stamp_ns
        if not self._is_joined:
            self._is_joined = True
            tree = message_encoding.encode_transforms(self._vehicle.placed, stamp_ns)
            yield TopicMessage(stamp_ns, TF_STATIC, messages.TF, tree)
        match frame:
            case CameraFrame():
                info = message_encoding.encode_camera_info(self._vehicle.cameras[frame.frame_id], stamp_ns)
                yield TopicMessage(stamp_ns, f"/{frame.frame_id}/camera_info", messages.CAMERA_INFO, info)
                type_name, data = message_encoding.encode_image(frame)
                yield TopicMessage(stamp_ns, image_topic(frame.frame_id), type_name, data)
            case LidarFrame():
                cloud = message_encoding.encode_cloud(frame)
                yield TopicMessage(stamp_ns, points_topic(frame.frame_id), messages.POINT_CLOUD, cloud)
            case EgoMotion():
                type_name, data = message_encoding.encode_motion(frame)
                yield TopicMessage(stamp_ns, ODOMETRY, type_name, data)


_STAMP: Final = {1: struct.Struct("<iI"), 0: struct.Struct(">iI")}
"""Layout of a header's stamp (sec, nanosec), by the byte order of the message, behind 4 bytes of encapsulation."""

_END_S: Final = 2**31
"""End of ROS time: 2038."""

_CLOCK_FIELDS: Final = ("timestamp", "time", "time_stamp", "t")
"""Fields of points in which some drivers write a clock's time instead of the time since the stamp. Only float64 has
enough digits for it."""

_UNITS_S: Final = (1.0, 1e-3, 1e-6, 1e-9)
"""Units of such clock times."""

_NEAR_S: Final = 60.0
"""Most time between a point's clock time and the stamp of its cloud."""


def shifted(message: TopicMessage, shift_ns: int) -> TopicMessage:
    """The message with `shift_ns` added to the stamp of its header, the stamps of its transforms and the clock times of
    its points. A header without a stamp (0) stays so. A type without a header, or an unknown type, keeps its bytes.

    Raises:
        DecodeError: the message does not fit its type, or a stamp would leave ROS time.
    """
    if shift_ns == 0:
        return message
    data = message.data
    match message.type_name:
        case messages.TF:
            data = _transforms(data, shift_ns)
        case messages.POINT_CLOUD:
            data = _cloud(data, shift_ns)
        case known if messages.has_header(known):
            data = _header(data, shift_ns)
    return replace(message, stamp_ns=message.stamp_ns + shift_ns, data=data)


def _header(data: bytes, shift_ns: int) -> bytes:
    layout = _STAMP.get(data[1]) if len(data) >= 4 + 8 else None
    if layout is None:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "the message ends within its header")
    seconds, nanoseconds = layout.unpack_from(data, 4)
    if seconds == nanoseconds == 0:
        return data
    return data[:4] + layout.pack(*_later(seconds, nanoseconds, shift_ns)) + data[12:]


def _transforms(data: bytes, shift_ns: int) -> bytes:
    message = messages.deserialized(ros.tf2_msgs__msg__TFMessage, data)
    for joint in message.transforms:
        stamp = joint.header.stamp
        stamp.sec, stamp.nanosec = _later(stamp.sec, stamp.nanosec, shift_ns)
    return messages.serialized(message, messages.TF)


def _cloud(data: bytes, shift_ns: int) -> bytes:
    message = messages.deserialized(ros.sensor_msgs__msg__PointCloud2, data)
    stamp_s = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
    clocks = [f for f in message.fields if f.name in _CLOCK_FIELDS and f.datatype == f.FLOAT64]
    if not clocks or message.width * message.height == 0:
        return _header(data, shift_ns)
    points: Any = message.data.copy()
    for field in clocks:
        try:
            times = np.ndarray(
                shape=(message.height, message.width),
                dtype=">f8" if message.is_bigendian else "<f8",
                buffer=points,
                offset=field.offset,
                strides=(row_step_of(message), message.point_step),
            )
        except (TypeError, ValueError) as error:
            raise DecodeError(Refusal.CLOUD_SHAPE, "the points do not fit into the message") from error
        with np.errstate(invalid="ignore", over="ignore"):
            middle = float(np.median(times[np.isfinite(times)])) if np.isfinite(times).any() else 0.0
            for unit_s in _UNITS_S:
                near = abs(middle * unit_s - stamp_s) < _NEAR_S < stamp_s
                if near or (stamp_s == 0.0 and SINCE_S < middle * unit_s < UNTIL_S):
                    times += shift_ns * 1e-9 / unit_s
                    break
    return _header(messages.serialized(replace(message, data=points), messages.POINT_CLOUD), shift_ns)


def _later(seconds: int, nanoseconds: int, shift_ns: int) -> tuple[int, int]:
    later_s, later_ns = divmod(seconds * 10**9 + nanoseconds + shift_ns, 10**9)
    if not 0 <= later_s < _END_S:
        raise DecodeError(Refusal.STAMP_INVALID, "the stamp would be before 1970, or after 2038")
    return later_s, later_ns
