"""Messages of a recording on ROS 2 topics, read or written, and the names of these topics.

In bags that coec writes, and by default in what it plays, the topics of a pair are below `/<pair>/`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from coec.adapters.ros import messages, outgoing
from coec.adapters.ros.camera_info import info_topic
from coec.adapters.ros.wire.qos import Qos
from coec.calibration.frames.sweep_times import azimuth_offsets_s
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, Matrix4, Rig
from coec.config import OpenPairConfig
from coec.schemas.ros_names import TF_STATIC

Frame = CameraFrame | LidarFrame | EgoMotion


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
        joints = [(rig.lidar_frame, outgoing.encode_tf_static(rig, self._T_camera_lidar, frame.stamp_ns))]
        if isinstance(frame, EgoMotion) and frame.frame_id != rig.lidar_frame:
            # The ego frame as a child of the LiDAR's frame; this transform, too, maps child to parent.
            below = replace(rig, camera_frame=rig.lidar_frame, lidar_frame=frame.frame_id)
            joints.append((frame.frame_id, outgoing.encode_tf_static(below, rig.T_lidar_ego, frame.stamp_ns)))
        return joints

    def _messages(self, frame: Frame) -> list[tuple[str, str, bytes]]:
        topics = self._topics
        match frame:
            case CameraFrame():
                type_name, data = outgoing.encode_image(frame)
                image = topics.image if type_name == messages.COMPRESSED_IMAGE else topics.image_raw
                info = outgoing.encode_camera_info(self._rig, frame.stamp_ns)
                return [(topics.info, messages.CAMERA_INFO, info), (image, type_name, data)]
            case LidarFrame():
                return [(topics.points, messages.POINT_CLOUD, outgoing.encode_cloud(_timed(self._rig, frame)))]
            case EgoMotion():
                type_name, data = outgoing.encode_motion(frame)
                topic = topics.turns if type_name == messages.IMU else topics.motion
                return [] if topic is None else [(topic, type_name, data)]


def _timed(rig: Rig, sweep: LidarFrame) -> LidarFrame:
    """The sweep with the time of each point, because messages have no other place for the rig's sweep timing."""
    if sweep.time_offset_s is not None or rig.sweep is None:
        return sweep
    return replace(sweep, time_offset_s=azimuth_offsets_s(sweep.xyz_m, rig.sweep).astype(np.float32))
