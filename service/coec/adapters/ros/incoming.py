"""Decodes ROS 2 messages in CDR to frames.

Every length in a message is only a claim of the sender, so that it is checked before a decoder builds anything from it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.frames.incoming import Refusal, check_size
from coec.adapters.ros import images, messages, motion, point_cloud2
from coec.adapters.ros.heads import check_cloud_fields, check_header
from coec.adapters.ros.messages import deserialized
from coec.adapters.ros.stamps import frame_id, stamp_ns
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import LimitsConfig, PointTimeConfig
from coec.errors import DecodeError

_LIVOX: Final = "Livox's own message is no PointCloud2: start its driver with xfer_format 0 (or 2), which sends that"
_VIDEO: Final = "packets of video are no pictures: take the camera's topic of JPEG (image_transport) or of raw pixels"
_PACKETS: Final = "packets of the LiDAR are no points: take the topic on which its driver sends PointCloud2"

REFUSED: Final = {
    "livox_ros_driver/msg/CustomMsg": _LIVOX,
    "livox_ros_driver2/msg/CustomMsg": _LIVOX,
    "livox_interfaces/msg/CustomMsg": _LIVOX,
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": _VIDEO,
    "foxglove_msgs/msg/CompressedVideo": _VIDEO,
    "theora_image_transport/msg/Packet": _VIDEO,
    "velodyne_msgs/msg/VelodyneScan": _PACKETS,
    "ouster_sensor_msgs/msg/PacketMsg": _PACKETS,
    "ouster_msgs/msg/PacketMsg": _PACKETS,
    "hesai_ros_driver/msg/UdpFrame": _PACKETS,
    "rslidar_msg/msg/RslidarPacket": _PACKETS,
    "sensor_msgs/msg/PointCloud": "PointCloud has been replaced by PointCloud2: convert it (point_cloud_converter)",
    messages.TF: "a transform tells where a frame is, not what it sees; it counts as motion if `ego.type` is this one",
}
"""Types that people configure by mistake, and what to do instead."""


def decode(
    type_name: str,
    payload: bytes,
    limits: LimitsConfig,
    *,
    point_time: PointTimeConfig | None = None,
    source: int | None = None,
) -> CameraFrame | LidarFrame | EgoMotion:
    """The frame in a message of one of the types in `KNOWN`.

    Stamp and frame id are those of the header, except for an odometry, whose frame id is that of the child frame, in
    which its twist is expressed. CDR has no sequence number. `point_time` says how points are timed if their values do
    not show it; `source` is the requested LiDAR in a cloud of several (see `of_source`).

    Raises:
        DecodeError: any other message, with a reason of `Refusal`.
    """
    if type_name in _MOTIONS:
        return _MOTIONS[type_name](payload)
    check_size(payload, limits)
    match type_name:
        case messages.COMPRESSED_IMAGE:
            return _compressed_image(payload, limits)
        case messages.IMAGE:
            return _image(payload, limits)
        case messages.POINT_CLOUD:
            return _point_cloud(payload, limits, point_time, source)
        case _:
            instead = REFUSED.get(type_name, f"messages of this type are not read; known: {', '.join(KNOWN)}")
            raise DecodeError(Refusal.MESSAGE_TYPE, instead)


_MOTIONS: Final[dict[str, Callable[[bytes], EgoMotion]]] = {
    messages.ODOMETRY: motion.odometry,
    messages.TWIST: motion.twist,
    messages.TWIST_WITH_COVARIANCE: motion.twist_with_covariance,
    messages.IMU: motion.imu,
}

KNOWN: Final = (messages.COMPRESSED_IMAGE, messages.IMAGE, messages.POINT_CLOUD, *_MOTIONS)
"""Types of messages that hold a frame."""


def _compressed_image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    check_header(payload)
    message = deserialized(ros.sensor_msgs__msg__CompressedImage, payload)
    image = images.compressed_image(message, limits)
    return CameraFrame(stamp_ns(message.header), frame_id(message.header.frame_id), image)


def _image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    check_header(payload)
    message = deserialized(ros.sensor_msgs__msg__Image, payload)
    image = images.raw_pixels(message, limits)
    return CameraFrame(stamp_ns(message.header), frame_id(message.header.frame_id), image)


def _point_cloud(
    payload: bytes, limits: LimitsConfig, point_time: PointTimeConfig | None, source: int | None
) -> LidarFrame:
    check_cloud_fields(payload)
    message = deserialized(ros.sensor_msgs__msg__PointCloud2, payload)
    frame_id(message.header.frame_id)
    return point_cloud2.frame_of(message, stamp_ns(message.header), limits, point_time=point_time, source=source)
