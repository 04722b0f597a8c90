"""ROS 2 messages in CDR: frames in.

Every length in a message is the sender's claim: what a decoder would build from it is bounded before it is
asked to.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Final

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.frames.incoming import MAX_FRAME_ID, MAX_SPEED, Refusal, check_size
from coec.adapters.images.codec import CHANNELS, probe, raw_image
from coec.adapters.ros import point_cloud2
from coec.adapters.ros.messages import COMPRESSED_IMAGE, IMAGE, ODOMETRY, POINT_CLOUD, TWIST, deserialized
from coec.calibration.types import CameraFrame, EgoMotion, ImageFormat, LidarFrame
from coec.config import LimitsConfig
from coec.errors import DecodeError

_MAX_CLOUD_FIELDS = 64
"""Drivers write up to about a dozen. Each would become a Python object."""


def decode(
    type_name: str, payload: bytes, limits: LimitsConfig, *, source: int | None = None
) -> CameraFrame | LidarFrame | EgoMotion:
    """The frame in a message of type `CompressedImage`, `Image`, `PointCloud2`, `Odometry` or `TwistStamped`.

    Stamp and frame id are those of the header; of an odometry the frame id is the child's, in which its twist
    is expressed. CDR has no sequence number. `source` is the LiDAR that is asked for, of a cloud of several (see
    `of_source`).

    Raises:
        DecodeError: anything else, with a reason of `Refusal`.
    """
    if type_name not in _DECODERS:
        raise DecodeError(Refusal.MESSAGE_TYPE, f"messages of this type are not read; known: {', '.join(_DECODERS)}")
    check_size(payload, limits)
    if type_name == POINT_CLOUD:
        return _point_cloud(payload, limits, source)
    return _DECODERS[type_name](payload, limits)


def _compressed_image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    message = deserialized(ros.sensor_msgs__msg__CompressedImage, payload)
    # `format` is free text ("jpeg", "bgr8; jpeg compressed bgr8", ...): the first bytes of the data are what
    # counts.
    image = probe(message.data.tobytes(), limits)
    return CameraFrame(_stamp_ns(message.header), _frame_id(message.header.frame_id), image)


def _image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    message = deserialized(ros.sensor_msgs__msg__Image, payload)
    try:
        form = ImageFormat(message.encoding)
        row = message.width * CHANNELS[form]
    except (ValueError, KeyError):
        raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, f"raw images must be one of {', '.join(CHANNELS)}") from None
    if message.step < row or message.data.size < (message.height - 1) * message.step + row:
        raise DecodeError(
            Refusal.IMAGE_SIZE_MISMATCH,
            f"{message.height} rows of {row} bytes, {message.step} apart, do not fit into {message.data.size}",
        )
    pixels = message.data
    if message.step != row:
        pixels = np.lib.stride_tricks.as_strided(pixels, (message.height, row), (message.step, 1), writeable=False)
    else:
        pixels = pixels[: message.height * row]
    image = raw_image(form, message.width, message.height, pixels.tobytes(), limits)
    return CameraFrame(_stamp_ns(message.header), _frame_id(message.header.frame_id), image)


def _point_cloud(payload: bytes, limits: LimitsConfig, source: int | None = None) -> LidarFrame:
    _check_cloud_fields(payload)
    message = deserialized(ros.sensor_msgs__msg__PointCloud2, payload)
    _frame_id(message.header.frame_id)
    return point_cloud2.frame_of(message, _stamp_ns(message.header), limits, source=source)


def _odometry(payload: bytes, limits: LimitsConfig) -> EgoMotion:
    del limits
    message = deserialized(ros.nav_msgs__msg__Odometry, payload)
    frame_id = message.child_frame_id or message.header.frame_id
    return _motion(_stamp_ns(message.header), frame_id, message.twist.twist)


def _twist(payload: bytes, limits: LimitsConfig) -> EgoMotion:
    del limits
    message = deserialized(ros.geometry_msgs__msg__TwistStamped, payload)
    return _motion(_stamp_ns(message.header), message.header.frame_id, message.twist)


_DECODERS: Final[dict[str, Callable[[bytes, LimitsConfig], CameraFrame | LidarFrame | EgoMotion]]] = {
    COMPRESSED_IMAGE: _compressed_image,
    IMAGE: _image,
    POINT_CLOUD: _point_cloud,
    ODOMETRY: _odometry,
    TWIST: _twist,
}


def _check_cloud_fields(payload: bytes) -> None:
    """Reads the number of fields ahead of the decoder: encapsulation, header, height, width, count."""
    order = "<" if payload[1:2] == b"\x01" else ">"
    try:
        (length,) = struct.unpack_from(f"{order}I", payload, 4 + 8)
        body = 8 + 4 + length
        (count,) = struct.unpack_from(f"{order}I", payload, 4 + body + (-body) % 4 + 8)
    except struct.error as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "the cloud ends within its header") from error
    if count > _MAX_CLOUD_FIELDS:
        raise DecodeError(Refusal.CLOUD_FIELDS, f"the cloud has more than {_MAX_CLOUD_FIELDS} fields")


def _stamp_ns(header: ros.std_msgs__msg__Header) -> int:
    seconds, nanoseconds = header.stamp.sec, header.stamp.nanosec
    if seconds < 0 or nanoseconds >= 10**9:
        raise DecodeError(Refusal.STAMP_INVALID, "the stamp is negative or has more than 10⁹ nanoseconds")
    return seconds * 10**9 + nanoseconds


def _frame_id(frame_id: str) -> str:
    if len(frame_id) > MAX_FRAME_ID:
        raise DecodeError(Refusal.FRAME_ID_INVALID, f"the frame id is longer than {MAX_FRAME_ID} characters")
    return frame_id


def _motion(stamp_ns: int, frame_id: str, twist: ros.geometry_msgs__msg__Twist) -> EgoMotion:
    linear, angular = twist.linear, twist.angular
    motion = EgoMotion(stamp_ns, _frame_id(frame_id), (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z))
    if not all(math.isfinite(v) and abs(v) <= MAX_SPEED for v in (*motion.linear_mps, *motion.angular_radps)):
        raise DecodeError(Refusal.MOTION_INVALID, "a velocity is not finite or beyond every vehicle")
    return motion
