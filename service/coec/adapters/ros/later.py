"""Shifts recorded messages in time, as if they had been recorded later."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any, Final

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.frames.incoming import Refusal
from coec.adapters.ros import messages
from coec.adapters.ros.point_time import SINCE_S, UNTIL_S
from coec.adapters.ros.topics import TopicMessage
from coec.errors import DecodeError

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
                strides=(message.row_step, message.point_step),
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
