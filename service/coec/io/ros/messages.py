"""The known types of ROS 2 messages and their conversion from and to CDR. What precedes the data in a message (header,
stamp, frame id, fields of a cloud) is read with bounds before a decoder builds anything from it. The definitions
are those of Humble, which are the same up to Lyrical for these types.
"""

import struct
from typing import Any, Final, TypeVar

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.stores import ros2_humble as ros

from coec.errors import DecodeError
from coec.io.frame_validation import MAX_FRAME_ID, Refusal

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

FFMPEG_PACKET: Final = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
COMPRESSED_VIDEO: Final = "foxglove_msgs/msg/CompressedVideo"
VELODYNE_SCAN: Final = "velodyne_msgs/msg/VelodyneScan"
OUSTER_PACKETS: Final = tuple(
    f"{package}/msg/PacketMsg" for package in ("ouster_sensor_msgs", "ouster_msgs", "ouster_ros")
)
HESAI_PACKETS: Final = "hesai_ros_driver/msg/UdpFrame"
PANDAR_PACKETS: Final = "pandar_msgs/msg/PandarScan"
NEBULA_PACKETS: Final = "nebula_msgs/msg/NebulaPackets"
HESAI: Final = (HESAI_PACKETS, PANDAR_PACKETS, NEBULA_PACKETS)
ROBOSENSE_PACKET: Final = "rslidar_msg/msg/RslidarPacket"
STRING: Final = "std_msgs/msg/String"
BYTES: Final = "std_msgs/msg/UInt8MultiArray"
COMPRESSED_CLOUD: Final = "point_cloud_interfaces/msg/CompressedPointCloud2"
FOXGLOVE_CLOUD: Final = "foxglove_msgs/msg/CompressedPointCloud"

_DEFINITIONS: Final = {
    FFMPEG_PACKET: "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
    "bool is_bigendian\nuint8[] data\n",
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    VELODYNE_SCAN: "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
    "nebula_msgs/msg/NebulaPacket": "builtin_interfaces/Time stamp\nuint8[] data\n",
    NEBULA_PACKETS: "std_msgs/Header header\nnebula_msgs/NebulaPacket[] packets\n",
    ROBOSENSE_PACKET: "std_msgs/Header header\nuint8 is_difop\nuint8 is_frame_begin\nuint8[] data\n",
    **dict.fromkeys(OUSTER_PACKETS, "uint8[] buf\n"),
    COMPRESSED_CLOUD: "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] compressed_data\nbool is_dense\nstring format\n",
    FOXGLOVE_CLOUD: "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\nuint8[] data\n"
    "string format\n",
    COMPRESSED_VIDEO: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
}
"""Of types that are not ROS's own."""

OTHER_TYPES: Final = tuple(_DEFINITIONS)
"""Types that are not ROS's own, and that are read."""

_STORE = get_typestore(Stores.ROS2_HUMBLE)
for _name, _definition in _DEFINITIONS.items():
    _STORE.register(get_types_from_msg(_definition, _name))

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
    message = deserialized_by_name(message_type.__msgtype__, payload)  # type: ignore[attr-defined]
    if not isinstance(message, message_type):
        raise TypeError(f"the type store made {type(message)} of {message_type}")
    return message


def message_class(type_name: str) -> Any:
    """The class of a type by its name, which may be one of `OTHER_TYPES`."""
    return _STORE.types[type_name]


def deserialized_by_name(type_name: str, payload: bytes) -> Any:
    """The same, of a type by its name, which may be one of `OTHER_TYPES`."""
    try:
        return _STORE.deserialize_cdr(memoryview(payload), type_name)
    except (SerdeError, ValueError, IndexError, struct.error) as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "not this message in CDR, or cut off") from error


def serialized(message: Any, type_name: str) -> bytes:
    """CDR, little endian, with its encapsulation header."""
    return bytes(_STORE.serialize_cdr(message, type_name, little_endian=True))


def cdr_of_ros_1(data: bytes, type_name: str) -> bytes:
    """A message of ROS 1 as one of ROS 2, in CDR, by the definition of ROS 2: they differ by the header's `seq`.

    Raises:
        SerdeError, ValueError, IndexError, AssertionError: the data is not this message.
    """
    return bytes(_STORE.ros1_to_cdr(data, type_name))


def known_types() -> tuple[str, ...]:
    """The names of ROS's own types, and of `OTHER_TYPES`, sorted."""
    return tuple(sorted(_STORE.fielddefs))


def is_known(type_name: str) -> bool:
    """Whether its definition is known, and so its hash: that of ROS's own types, and of packets of LiDARs."""
    return type_name in _STORE.fielddefs


def has_header(type_name: str) -> bool:
    """Whether its messages are known to begin with a `std_msgs/Header`."""
    fields = _STORE.fielddefs[type_name][1] if is_known(type_name) and type_name not in _DEFINITIONS else []
    return bool(fields) and fields[0][0] == "header"


def type_hash(type_name: str) -> str:
    """`RIHS01_` and 64 hexadecimal digits, by which ROS 2 distinguishes definitions with one name (REP 2016)."""
    return str(_STORE.hash_rihs01(type_name))


MAX_CLOUD_FIELDS: Final = 64
"""Most fields of a cloud; drivers write up to about a dozen. The limit exists because each becomes a Python object."""

MAX_FIELD_NAME: Final = 256
"""Most bytes of the name of a field; drivers use up to some twenty."""

_ORDERS: Final = {b"\x00": ">", b"\x01": "<"}
"""Byte order by the second byte of the encapsulation (plain CDR)."""

_ENCAPSULATION: Final = 4
"""Bytes before the message; alignment counts from their end."""

_STAMP: Final = 8
"""Bytes of `std_msgs/Header.stamp`."""

_CHARACTER: Final = 4
"""Most bytes of a character in UTF-8."""


class MessageCursor:
    """A cursor that moves through a message from its beginning.

    Raises:
        DecodeError: `message_malformed`: not CDR, or the message ends before the requested value.
    """

    def __init__(self, payload: bytes) -> None:
        order = _ORDERS.get(payload[1:2])
        if order is None:
            raise DecodeError(Refusal.MESSAGE_MALFORMED, "not a message in CDR")
        self._payload = payload
        self._order = order
        self._at = _ENCAPSULATION

    def number(self) -> int:
        """The next uint32."""
        self._at += -(self._at - _ENCAPSULATION) % 4
        try:
            (value,) = struct.unpack_from(f"{self._order}I", self._payload, self._at)
        except struct.error as error:
            raise DecodeError(Refusal.MESSAGE_MALFORMED, "the message ends within its head") from error
        self._at += 4
        return int(value)

    def byte(self) -> int:
        """The next uint8."""
        if self._at >= len(self._payload):
            raise DecodeError(Refusal.MESSAGE_MALFORMED, "the message ends within its head")
        self._at += 1
        return self._payload[self._at - 1]

    def place(self) -> int:
        """Where the next uint32 stands in the message."""
        return self._at + -(self._at - _ENCAPSULATION) % 4

    def skip(self, size: int) -> None:
        """Skips `size` bytes."""
        self._at += size

    def text(self, max_bytes: int, reason: Refusal, what: str) -> None:
        """Skips a string.

        Raises:
            DecodeError: with `reason`, if the string claims to be longer than `max_bytes`.
        """
        length = self.number()
        if length > max_bytes + 1:  # the zero behind it counts
            raise DecodeError(reason, f"{what} is longer than {max_bytes} bytes")
        self.skip(length)


def check_header(payload: bytes) -> MessageCursor:
    """Checks the `std_msgs/Header` at the beginning of a message. Returns the cursor behind it.

    Raises:
        DecodeError: `frame_id_invalid` or `message_malformed`.
    """
    head = MessageCursor(payload)
    head.skip(_STAMP)
    head.text(_CHARACTER * MAX_FRAME_ID, Refusal.FRAME_ID_INVALID, "the frame id")
    return head


def header_frame_id(payload: bytes) -> str:
    """The frame id of the `std_msgs/Header` at the beginning of a message, without decoding the rest; empty if there is
    none, or it is too long or no text."""
    order, begin = _ORDERS.get(payload[1:2]), _ENCAPSULATION + _STAMP + 4
    if order is None or len(payload) < begin:
        return ""
    (length,) = struct.unpack_from(f"{order}I", payload, begin - 4)
    if length > _CHARACTER * MAX_FRAME_ID + 1:
        return ""
    return payload[begin : begin + length].rstrip(b"\0").decode(errors="replace")[:MAX_FRAME_ID]


def is_empty_cloud(payload: bytes) -> bool:
    """Whether a `PointCloud2` states that it has no point."""
    try:
        head = check_header(payload)
        return head.number() * head.number() == 0
    except DecodeError:
        return False


def check_cloud_fields(payload: bytes) -> None:
    """Checks the fields of a `PointCloud2`, or of a packed one.

    Raises:
        DecodeError: `cloud_fields`, `frame_id_invalid` or `message_malformed`.
    """
    head = check_header(payload)
    head.number()  # height
    head.number()  # width
    count = head.number()
    if count > MAX_CLOUD_FIELDS:
        raise DecodeError(Refusal.CLOUD_FIELDS, f"the cloud has more than {MAX_CLOUD_FIELDS} fields")
    for _ in range(count):
        head.text(MAX_FIELD_NAME, Refusal.CLOUD_FIELDS, "the name of a field")
        head.number()  # offset
        head.skip(1)  # datatype
        head.number()  # count


def stamp_ns(header: ros.std_msgs__msg__Header) -> int:
    """Nanoseconds of the header's stamp.

    Raises:
        DecodeError: `stamp_invalid`.
    """
    seconds, nanoseconds = header.stamp.sec, header.stamp.nanosec
    if seconds < 0 or nanoseconds >= 10**9:
        raise DecodeError(Refusal.STAMP_INVALID, "the stamp is negative or has more than 10⁹ nanoseconds")
    return seconds * 10**9 + nanoseconds


def frame_id(text: str) -> str:
    """The frame id, unchanged, if it is not too long.

    Raises:
        DecodeError: `frame_id_invalid`.
    """
    if len(text) > MAX_FRAME_ID:
        raise DecodeError(Refusal.FRAME_ID_INVALID, f"the frame id is longer than {MAX_FRAME_ID} characters")
    return text
