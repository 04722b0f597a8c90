"""Livox's own message (`livox_ros_driver2/msg/CustomMsg`, of all its drivers the same) as a `PointCloud2`, in ROS 2's
encoding and in that of ROS 1. A point has 19 bytes: nanoseconds since the message's time, x, y, z, reflectivity, tag
and line. In CDR each begins at a multiple of four.
"""

import struct
from typing import Final

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.errors import DecodeError
from coec.io.frame_validation import MAX_FRAME_ID, Refusal
from coec.io.ros.messages import check_header

TYPES: Final = (
    "livox_ros_driver2/msg/CustomMsg",
    "livox_ros_driver/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)

_POINT: Final = 19
"""Bytes of a point."""

_FIXED: Final = struct.Struct("<QI4xI")
"""Time base, number of points, LiDAR and reserved bytes, and the length of the list."""

_FIELDS: Final = (("offset_time", 0, 6), ("x", 4, 7), ("y", 8, 7), ("z", 12, 7), ("intensity", 16, 2), ("line", 18, 2))
"""Name, offset and `PointField.datatype` of what is read; `tag` says how noisy a return is."""


def cloud_of_cdr(payload: bytes) -> ros.sensor_msgs__msg__PointCloud2:
    """The cloud of a message in CDR, little endian.

    Raises:
        DecodeError: `message_malformed`, `frame_id_invalid` or `cloud_empty`.
    """
    check_header(payload)
    if payload[1] != 1:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "a cloud of Livox in big-endian CDR is not read")
    return _cloud(payload, 4, 4, _POINT + 1)


def cloud_of_ros_1(data: bytes) -> ros.sensor_msgs__msg__PointCloud2:
    """The cloud of a message of ROS 1, whose header begins with a sequence number.

    Raises:
        DecodeError: as above.
    """
    return _cloud(data, 4, 1, _POINT)


def _cloud(data: bytes, at: int, alignment: int, stride: int) -> ros.sensor_msgs__msg__PointCloud2:
    """The cloud of a message whose stamp stands at `at`, and whose values are aligned to as many bytes behind it."""
    try:
        seconds, nanoseconds, length = struct.unpack_from("<iII", data, at)
        frame = data[at + 12 : at + 12 + length]
        if length > 4 * MAX_FRAME_ID + 1 or len(frame) != length:
            raise DecodeError(Refusal.FRAME_ID_INVALID, "the frame id is too long, or cut off")
        end = at + 12 + length
        begin = end + (-(end - at) % (2 * alignment) if alignment > 1 else 0)
        _, _, count = _FIXED.unpack_from(data, begin)
    except struct.error as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "the message ends within its head") from error
    begin += _FIXED.size
    # The last point is not padded.
    size = count * stride - (stride - _POINT)
    if count == 0:
        raise DecodeError(Refusal.CLOUD_EMPTY, "the cloud has no point")
    if size > len(data) - begin:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, f"{count} points of {stride} bytes do not fit into the message")
    stamp = ros.builtin_interfaces__msg__Time(seconds, nanoseconds)
    header = ros.std_msgs__msg__Header(stamp, frame.rstrip(b"\0").decode(errors="replace"))
    points = np.frombuffer(data[begin : begin + size] + bytes(stride - _POINT), np.uint8)
    fields = [ros.sensor_msgs__msg__PointField(name, offset, kind, 1) for name, offset, kind in _FIELDS]
    return ros.sensor_msgs__msg__PointCloud2(header, 1, count, fields, False, stride, count * stride, points, True)
