"""The frames of several sensors of a vehicle as messages: each sensor has its topics, all share one transform tree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from coec.adapters.ros import messages, outgoing
from coec.adapters.ros.outgoing import PlacedFrame
from coec.adapters.ros.topics import Frame, TopicMessage
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, Rig
from coec.schemas.ros_names import TF_STATIC

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
