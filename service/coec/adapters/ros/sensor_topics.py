"""The frames of several sensors of a vehicle as messages: each on topics of its own, all in one tree of transforms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from coec.adapters.ros import messages, outgoing
from coec.adapters.ros.outgoing import Placed
from coec.adapters.ros.topics import Frame, TopicMessage
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, Rig
from coec.schemas.ros_names import TF_STATIC

ODOMETRY = "/odometry"


@dataclass(frozen=True, slots=True)
class Vehicle:
    """What is said of a vehicle beside its frames.

    Attributes:
        cameras: a rig with the intrinsics of each camera, by its frame of coordinates.
        placed: where each sensor is in the vehicle.
    """

    cameras: Mapping[str, Rig]
    placed: Sequence[Placed]


def image_topic(camera: str) -> str:
    """Of the compressed images of a camera; its camera info lies beside."""
    return f"/{camera}/image/compressed"


def points_topic(lidar: str) -> str:
    """Of the sweeps of a LiDAR."""
    return f"/{lidar}/points"


class SensorTopics:
    """Frames as messages on topics by the names of their sensors, and `/tf_static` before the first."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._is_joined = False

    def of(self, frame: Frame) -> Iterator[TopicMessage]:
        """Those of the next frame; depth maps are left out."""
        stamp_ns = frame.stamp_ns
        if not self._is_joined:
            self._is_joined = True
            tree = outgoing.encode_transforms(self._vehicle.placed, stamp_ns)
            yield TopicMessage(stamp_ns, TF_STATIC, messages.TF, tree)
        match frame:
            case CameraFrame():
                info = outgoing.encode_camera_info(self._vehicle.cameras[frame.frame_id], stamp_ns)
                yield TopicMessage(stamp_ns, f"/{frame.frame_id}/camera_info", messages.CAMERA_INFO, info)
                type_name, data = outgoing.encode_image(frame)
                yield TopicMessage(stamp_ns, image_topic(frame.frame_id), type_name, data)
            case LidarFrame():
                cloud = outgoing.encode_cloud(frame)
                yield TopicMessage(stamp_ns, points_topic(frame.frame_id), messages.POINT_CLOUD, cloud)
            case EgoMotion():
                type_name, data = outgoing.encode_motion(frame)
                yield TopicMessage(stamp_ns, ODOMETRY, type_name, data)
