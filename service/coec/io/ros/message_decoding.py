"""Decodes ROS 2 messages in CDR to frames: images, clouds, and ego-motion from messages with a velocity.

Every length in a message is only a claim of the sender, so that it is checked before a decoder builds anything from
it.
"""

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__CompressedImage as CompressedImage
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__Image as Image

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame
from coec.config import LimitsConfig, PointTimeConfig
from coec.errors import DecodeError
from coec.io import converted_images
from coec.io.frame_validation import MAX_SPEED, Refusal, check_size
from coec.io.images import BYTES_PER_PIXEL, probe, raw_image
from coec.io.ros import livox, messages, point_clouds
from coec.io.ros.messages import check_cloud_fields, check_header, deserialized, frame_id, stamp_ns

ENCODINGS: Final[dict[str, ImageFormat]] = {
    **{form.value: form for form in BYTES_PER_PIXEL},
    "8UC1": ImageFormat.MONO8,
    "8UC3": ImageFormat.BGR8,
    "8UC4": ImageFormat.BGRA8,
    "16UC1": ImageFormat.MONO16,
    "uyvy": ImageFormat.YUV422,
    "yuyv": ImageFormat.YUV422_YUY2,
}
"""`Image.encoding`: the names of sensor_msgs/image_encodings.hpp, and OpenCV's types. The latter do not say what the
channels mean, so that OpenCV's order is assumed."""

_DEEP: Final = tuple(name for name, form in ENCODINGS.items() if form.endswith("16"))
"""Encodings with two bytes per value."""

_VIDEO_FORMATS: Final = ("h264", "h265", "hevc", "av1", "vp8", "vp9")
"""Video codecs of ffmpeg_image_transport and others; a packet alone is no picture, as it needs those before it."""

_START_CODES: Final = (b"\0\0\0\1", b"\0\0\1")
"""Beginnings of a packet of H.264 or H.265 (ITU-T H.264, annex B)."""


def compressed_image(message: CompressedImage, limits: LimitsConfig) -> EncodedImage:
    """The image of a message. `format` is free text ("jpeg", "bgr8; jpeg compressed bgr8", "rgb8; png compressed "), so
    that the first bytes of the data decide. `format` only serves to refuse depth images and video with a clear message.

    Raises:
        DecodeError: `image_unknown_format`, or the reasons of `probe`.
    """
    text = message.format.lower()
    data = message.data.tobytes()
    if "compresseddepth" in text:
        raise DecodeError(
            Refusal.IMAGE_UNKNOWN_FORMAT,
            "a depth image (compressedDepth) is no camera's picture: take the topic that ends with /compressed",
        )
    if any(codec in text for codec in _VIDEO_FORMATS) or data.startswith(_START_CODES):
        raise DecodeError(
            Refusal.IMAGE_UNKNOWN_FORMAT,
            "packets of video (h264 and the like) are not read: take the camera's topic of JPEG or of raw pixels",
        )
    converted = converted_images.from_file(data, limits)
    return probe(data, limits) if converted is None else converted


def raw_pixels(message: Image, limits: LimitsConfig) -> EncodedImage:
    """The image of a message, without row padding and with little-endian 16-bit values.

    Raises:
        DecodeError: `image_unknown_format`, `image_size_mismatch`, or the reasons of `raw_image`.
    """
    size = (message.width, message.height, message.step, message.data)
    if message.encoding in converted_images.SEMIPLANAR:
        return converted_images.from_semiplanar(message.encoding, *size, limits)
    if message.encoding in converted_images.DEEP_COLOURS:
        return converted_images.from_deep_colours(message.encoding, *size, bool(message.is_bigendian), limits)
    form = ENCODINGS.get(message.encoding)
    if form is None:
        known = ", ".join((*ENCODINGS, *converted_images.SEMIPLANAR, *converted_images.DEEP_COLOURS))
        raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, f"raw images must be one of {known}")
    row = message.width * BYTES_PER_PIXEL[form]
    pixels = converted_images.rows_of(message.data, message.height, row, message.step)
    data = pixels.tobytes()
    if message.is_bigendian and message.encoding in _DEEP:
        data = np.frombuffer(data, np.uint16).byteswap().tobytes()
    return raw_image(form, message.width, message.height, data, limits)


MAX_MOTION_BYTES: Final = 4096
"""Largest message. An odometry has 724 bytes and its two frame ids."""

Vector = tuple[float, float, float]


def odometry(payload: bytes) -> EgoMotion:
    """The twist of an `Odometry`, which is expressed in its child frame.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    check_motion(payload)
    message = deserialized(ros.nav_msgs__msg__Odometry, payload)
    return _twisted(message.header, message.child_frame_id or message.header.frame_id, message.twist.twist)


def twist(payload: bytes) -> EgoMotion:
    """The twist of a `TwistStamped`, expressed in the frame of its header.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    check_motion(payload)
    message = deserialized(ros.geometry_msgs__msg__TwistStamped, payload)
    return _twisted(message.header, message.header.frame_id, message.twist)


def twist_with_covariance(payload: bytes) -> EgoMotion:
    """The same for a `TwistWithCovarianceStamped`; its covariance is not used.

    Raises:
        DecodeError: the reasons of `checked`, or not this message.
    """
    check_motion(payload)
    message = deserialized(ros.geometry_msgs__msg__TwistWithCovarianceStamped, payload)
    return _twisted(message.header, message.header.frame_id, message.twist.twist)


def imu(payload: bytes) -> EgoMotion:
    """The turn rates of an `Imu`, about the axes of its own frame; the linear velocity is not known.

    Raises:
        DecodeError: the reasons of `checked`, not this message, or the IMU says that it does not measure turn rates.
    """
    check_motion(payload)
    message = deserialized(ros.sensor_msgs__msg__Imu, payload)
    if message.angular_velocity_covariance[0] == -1.0:  # sensor_msgs/Imu: "does not produce" it
        raise DecodeError(Refusal.MOTION_INVALID, "the IMU says that it does not measure turn rates")
    rates = message.angular_velocity
    stamp, frame = stamp_ns(message.header), frame_id(message.header.frame_id)
    return checked(stamp, frame, None, (rates.x, rates.y, rates.z))


def checked(stamp: int, frame: str, linear_mps: Vector | None, angular_radps: Vector) -> EgoMotion:
    """The motion, checked to be possible for a vehicle.

    Raises:
        DecodeError: `motion_invalid`.
    """
    if not all(math.isfinite(v) and abs(v) <= MAX_SPEED for v in (*(linear_mps or ()), *angular_radps)):
        raise DecodeError(Refusal.MOTION_INVALID, "a velocity is not finite or beyond every vehicle")
    return EgoMotion(stamp, frame, linear_mps, angular_radps)


def _twisted(header: ros.std_msgs__msg__Header, frame: str, twist: ros.geometry_msgs__msg__Twist) -> EgoMotion:
    linear, angular = twist.linear, twist.angular
    return checked(stamp_ns(header), frame_id(frame), (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z))


def check_motion(payload: bytes) -> None:
    """Raises DecodeError if the payload is too long for a message of motion, or does not begin with a header."""
    if len(payload) > MAX_MOTION_BYTES:
        raise DecodeError(Refusal.MESSAGE_TOO_LARGE, f"a message of motion has at most {MAX_MOTION_BYTES} bytes")
    check_header(payload)


_VIDEO: Final = (
    "packets of video are no pictures: take the camera's topic of JPEG (image_transport) or of raw pixels, or unpack "
    "them with `ros2 run image_transport republish`"
)
_PACKED: Final = (
    "clouds packed by point_cloud_transport (Draco, Cloudini, zlib) are not read: unpack them with `ros2 run "
    "point_cloud_transport republish`, and take the topic of PointCloud2"
)
_PACKETS: Final = "packets of the LiDAR are no points: take the topic on which its driver sends PointCloud2"

REFUSED: Final = {
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": _VIDEO,
    "foxglove_msgs/msg/CompressedVideo": _VIDEO,
    "foxglove_msgs/msg/CompressedPointCloud": _PACKED,
    "theora_image_transport/msg/Packet": _VIDEO,
    "velodyne_msgs/msg/VelodyneScan": _PACKETS,
    "ouster_sensor_msgs/msg/PacketMsg": _PACKETS,
    "ouster_msgs/msg/PacketMsg": _PACKETS,
    "hesai_ros_driver/msg/UdpFrame": _PACKETS,
    "rslidar_msg/msg/RslidarPacket": _PACKETS,
    "point_cloud_interfaces/msg/CompressedPointCloud2": _PACKED,
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
            check_cloud_fields(payload)
            message = deserialized(ros.sensor_msgs__msg__PointCloud2, payload)
            return _point_cloud(message, limits, point_time, source)
        case _ if type_name in livox.TYPES:
            return _point_cloud(livox.cloud_of_cdr(payload), limits, point_time, source)
        case _:
            instead = REFUSED.get(type_name, f"messages of this type are not read; known: {', '.join(KNOWN)}")
            raise DecodeError(Refusal.MESSAGE_TYPE, instead)


_MOTIONS: Final[dict[str, Callable[[bytes], EgoMotion]]] = {
    messages.ODOMETRY: odometry,
    messages.TWIST: twist,
    messages.TWIST_WITH_COVARIANCE: twist_with_covariance,
    messages.IMU: imu,
}

KNOWN: Final = (messages.COMPRESSED_IMAGE, messages.IMAGE, messages.POINT_CLOUD, *_MOTIONS, *livox.TYPES)
"""Types of messages that hold a frame."""


def _compressed_image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    check_header(payload)
    message = deserialized(ros.sensor_msgs__msg__CompressedImage, payload)
    image = compressed_image(message, limits)
    return CameraFrame(stamp_ns(message.header), frame_id(message.header.frame_id), image)


def _image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    check_header(payload)
    message = deserialized(ros.sensor_msgs__msg__Image, payload)
    image = raw_pixels(message, limits)
    return CameraFrame(stamp_ns(message.header), frame_id(message.header.frame_id), image)


def _point_cloud(
    message: ros.sensor_msgs__msg__PointCloud2,
    limits: LimitsConfig,
    point_time: PointTimeConfig | None,
    source: int | None,
) -> LidarFrame:
    frame_id(message.header.frame_id)
    return point_clouds.frame_of(message, stamp_ns(message.header), limits, point_time=point_time, source=source)
