"""The known types of ROS 2 messages, and their conversion from and to CDR. The definitions are those of Humble, which
are the same up to Lyrical for these types."""

from __future__ import annotations

import struct
from typing import Any, Final, TypeVar

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from coec.adapters.frames.incoming import Refusal
from coec.errors import DecodeError

COMPRESSED_IMAGE: Final = "sensor_msgs/msg/CompressedImage"
IMAGE: Final = "sensor_msgs/msg/Image"
POINT_CLOUD: Final = "sensor_msgs/msg/PointCloud2"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
TWIST: Final = "geometry_msgs/msg/TwistStamped"
TWIST_WITH_COVARIANCE: Final = "geometry_msgs/msg/TwistWithCovarianceStamped"
IMU: Final = "sensor_msgs/msg/Imu"
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
TF: Final = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"

_STORE = get_typestore(Stores.ROS2_HUMBLE)

T = TypeVar("T")


def definition(type_name: str) -> str:
    """The message definition in ros2msg text, with those that it refers to, as an MCAP schema needs it."""
    text, _ = _STORE.generate_msgdef(type_name, ros_version=2)
    return text


def deserialized(message_type: type[T], payload: bytes) -> T:
    """The message in a CDR payload of either byte order. Its arrays are read-only views of `payload`.

    Raises:
        DecodeError: the payload is not this message, or is cut off.
    """
    try:
        message = _STORE.deserialize_cdr(memoryview(payload), message_type.__msgtype__)  # type: ignore[attr-defined]
    except (SerdeError, ValueError, IndexError, struct.error) as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "not this message in CDR, or cut off") from error
    if not isinstance(message, message_type):
        raise TypeError(f"the type store made {type(message)} of {message_type}")
    return message


def serialized(message: Any, type_name: str) -> bytes:
    """CDR, little endian, with its encapsulation header."""
    return bytes(_STORE.serialize_cdr(message, type_name, little_endian=True))


def is_known(type_name: str) -> bool:
    """Whether it is one of ROS's own types; only their hashes are known."""
    return type_name in _STORE.fielddefs


def has_header(type_name: str) -> bool:
    """Whether its messages are known to begin with a `std_msgs/Header`."""
    fields = _STORE.fielddefs[type_name][1] if is_known(type_name) else []
    return bool(fields) and fields[0][0] == "header"


def type_hash(type_name: str) -> str:
    """`RIHS01_` and 64 hexadecimal digits, by which ROS 2 distinguishes definitions with one name (REP 2016)."""
    return str(_STORE.hash_rihs01(type_name))
