"""Messages in other encodings as ROS 2 messages in CDR: those of ROS 1, and Foxglove's schemas in protobuf and JSON
(images, video, clouds, calibrations, transforms, odometry). Recordings of these read like ROS 2 bags.

Protobuf is read by a few lines that know the wire format (protobuf.dev, "Encoding"), so that no library builds anything
from the lengths in a message; each length is checked against what is left. Foxglove's numbers of fields are those of
its published .proto files.
"""

import base64
import binascii
import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys.stores import ros2_humble as ros

from coec.errors import DecodeError
from coec.io.frame_validation import Refusal
from coec.io.ros import hesai_packets, messages, point_clouds

MAX_JSON_BYTES: Final = 64 * 2**20
"""Largest message in JSON: an image of 32 MiB has 43 MiB in base64."""

MAX_PARTS: Final = 4096
"""Most parts of a message in protobuf; a cloud has some twenty, a tree of transforms a few for each."""


@dataclass(frozen=True, slots=True)
class Translation:
    """How messages of one schema become those of ROS 2.

    Attributes:
        type_name: the type of ROS 2.
        convert: the message in CDR; raises DecodeError if it is not of the schema.
    """

    type_name: str
    convert: Callable[[bytes], bytes]


def translation_of(encoding: str, schema: str) -> int | None:
    """The number in `TRANSLATIONS` of the messages of a channel; None if they are not read."""
    return _NUMBERS.get((encoding, schema))


def _malformed(what: str) -> DecodeError:
    return DecodeError(Refusal.MESSAGE_MALFORMED, what)


# --- ROS 1 ----------------------------------------------------------------------------------------------------


def _from_ros_1(type_name: str) -> Callable[[bytes], bytes]:
    def convert(data: bytes) -> bytes:
        try:
            return messages.cdr_of_ros_1(data, type_name)
        except (SerdeError, ValueError, IndexError, AssertionError, struct.error) as error:
            raise _malformed(f"not a {type_name} of ROS 1, or cut off") from error

    return convert


_LIVOX: Final = Translation(
    messages.POINT_CLOUD, lambda data: messages.serialized(point_clouds.cloud_of_ros_1(data), messages.POINT_CLOUD)
)


def _ros_1() -> dict[tuple[str, str], Translation]:
    known = {name: name for name in messages.known_types() if "/msg/" in name} | {"tf/msg/tfMessage": messages.TF}
    livox = {("ros1", "livox_ros_driver/CustomMsg"): _LIVOX, ("ros1", "livox_ros_driver2/CustomMsg"): _LIVOX}
    hesai = Translation(messages.NEBULA_PACKETS, hesai_packets.cdr_of_ros_1)
    packets = {("ros1", "pandar_msgs/PandarScan"): hesai, ("ros1", "hesai_ros_driver/UdpFrame"): hesai}
    return (livox | packets) | {
        ("ros1", name.replace("/msg/", "/")): Translation(of_ros_2, _from_ros_1(of_ros_2))
        for name, of_ros_2 in known.items()
    }


# --- protobuf -------------------------------------------------------------------------------------------------

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
"""Wire types."""

Fields = Mapping[int, tuple[str, Any]]
"""Name and kind of each field by its number: a kind is `text`, `bytes`, `number`, `double`, `doubles`, the fields of a
message, or these in a list for a repeated message."""


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data) and shift < 70:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, at
    raise _malformed("a number of a protobuf message is cut off")


def _parts(data: bytes) -> list[tuple[int, int, Any]]:
    """Number, wire type and value of each part of a message."""
    parts: list[tuple[int, int, Any]] = []
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == _VARINT:
            value: Any
            value, at = _varint(data, at)
        elif kind in (_EIGHT, _FOUR, _BYTES):
            size = 8 if kind == _EIGHT else 4
            if kind == _BYTES:
                size, at = _varint(data, at)
            if size > len(data) - at:
                raise _malformed("a part of a protobuf message is cut off")
            value, at = data[at : at + size], at + size
        else:
            raise _malformed("not a message in protobuf")
        parts.append((key >> 3, kind, value))
        if len(parts) > MAX_PARTS:
            raise _malformed(f"a protobuf message has more than {MAX_PARTS} parts")
    return parts


def _protobuf(data: bytes, fields: Fields) -> dict[str, Any]:
    """The known fields of a message by name; a repeated one as a list."""
    values: dict[str, Any] = {}
    for number, kind, value in _parts(data):
        name, expected = fields.get(number, ("", None))
        if expected is None:
            continue
        if expected == "doubles":
            doubles = value if kind == _BYTES else value if kind == _EIGHT else b""
            values.setdefault(name, []).extend(np.frombuffer(doubles[: len(doubles) // 8 * 8], "<f8").tolist())
        elif isinstance(expected, list):
            values.setdefault(name, []).append(_protobuf(_of_kind(value, kind, _BYTES), expected[0]))
        elif isinstance(expected, dict):
            values[name] = _protobuf(_of_kind(value, kind, _BYTES), expected)
        elif expected == "number":
            values[name] = value if kind == _VARINT else int.from_bytes(_of_kind(value, kind, _FOUR), "little")
        elif expected == "double":
            values[name] = struct.unpack("<d", _of_kind(value, kind, _EIGHT))[0]
        else:
            content = _of_kind(value, kind, _BYTES)
            values[name] = content.decode(errors="replace") if expected == "text" else content
    return values


def _of_kind(value: Any, kind: int, expected: int) -> bytes:
    if kind != expected:
        raise _malformed("a part of a protobuf message has another wire type than its schema says")
    return bytes(value)


def _message(**fields: Any) -> Fields:
    """A message whose fields are numbered in this order, from 1."""
    return dict(enumerate(fields.items(), 1))


_TIMESTAMP: Final = _message(sec="number", nsec="number")
_VECTOR: Final = _message(x="double", y="double", z="double")
_QUATERNION: Final = _message(x="double", y="double", z="double", w="double")
_POSE: Final = _message(position=_VECTOR, orientation=_QUATERNION)
_TRANSFORM: Final = _message(
    timestamp=_TIMESTAMP, parent_frame_id="text", child_frame_id="text", translation=_VECTOR, rotation=_QUATERNION
)
_COMPRESSED_IMAGE: Final = _message(timestamp=_TIMESTAMP, data="bytes", format="text", frame_id="text")
_COMPRESSED_VIDEO: Final = _message(timestamp=_TIMESTAMP, frame_id="text", data="bytes", format="text")
_RAW_IMAGE: Final = _message(
    timestamp=_TIMESTAMP, width="number", height="number", encoding="text", step="number", data="bytes", frame_id="text"
)
_POINT_CLOUD: Final = _message(
    timestamp=_TIMESTAMP,
    frame_id="text",
    pose=_POSE,
    point_stride="number",
    fields=[_message(name="text", offset="number", type="number")],
    data="bytes",
)
_PACKED_CLOUD: Final = _message(timestamp=_TIMESTAMP, frame_id="text", pose=_POSE, data="bytes", format="text")
_ODOMETRY: Final = _message(
    timestamp=_TIMESTAMP,
    frame_id="text",
    body_frame_id="text",
    pose=_POSE,
    linear_velocity=_VECTOR,
    angular_velocity=_VECTOR,
)
_CALIBRATION: Final = _message(
    timestamp=_TIMESTAMP,
    width="number",
    height="number",
    distortion_model="text",
    **dict.fromkeys("DKRP", "doubles"),
    frame_id="text",
)

# --- Foxglove ---------------------------------------------------------------------------------------------------

_DATATYPES: Final = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""`PointField.datatype` by Foxglove's `NumericType`, which has the unsigned integers first."""


def _header(values: Mapping[str, Any]) -> Any:
    stamp = values.get("timestamp") or {}
    sec, nsec = int(stamp.get("sec", 0)), int(stamp.get("nsec", 0))
    if not (0 <= sec < 2**31 and 0 <= nsec < 10**9):
        raise DecodeError(Refusal.STAMP_INVALID, "the stamp is negative or has more than 10⁹ nanoseconds")
    return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(sec, nsec), str(values.get("frame_id", "")))


def _bytes_of(values: Mapping[str, Any]) -> Any:
    return np.frombuffer(values.get("data", b""), np.uint8)


def _compressed_image(values: Mapping[str, Any]) -> Any:
    return ros.sensor_msgs__msg__CompressedImage(_header(values), str(values.get("format", "")), _bytes_of(values))


def _raw_image(values: Mapping[str, Any]) -> Any:
    height, width, step = (_uint32(values, name) for name in ("height", "width", "step"))
    encoding = str(values.get("encoding", ""))
    return ros.sensor_msgs__msg__Image(_header(values), height, width, encoding, 0, step, _bytes_of(values))


def _point_cloud(values: Mapping[str, Any]) -> Any:
    pose = values.get("pose") or {}
    turn, place = pose.get("orientation") or {}, pose.get("position") or {}
    if any(float(part.get(axis, 0.0)) for part in (turn, place) for axis in "xyz"):
        raise DecodeError(Refusal.TRANSFORM_INVALID, "the cloud has a pose in its frame, which is not applied")
    fields = [
        ros.sensor_msgs__msg__PointField(
            str(one.get("name", "")), _uint32(one, "offset"), _DATATYPES.get(_uint32(one, "type"), 0), 1
        )
        for one in values.get("fields", ())
    ]
    data, step = _bytes_of(values), _uint32(values, "point_stride")
    if step == 0 or data.size % step:
        raise DecodeError(Refusal.CLOUD_SHAPE, f"{data.size} bytes are no points of {step} bytes")
    width = data.size // step
    return ros.sensor_msgs__msg__PointCloud2(_header(values), 1, width, fields, False, step, width * step, data, True)


def _packed_cloud(values: Mapping[str, Any]) -> Any:
    head, pose, form = _header(values), _pose(values.get("pose") or {}), str(values.get("format", ""))
    return messages.message_class(messages.FOXGLOVE_CLOUD)(head.stamp, head.frame_id, pose, _bytes_of(values), form)


def _odometry(values: Mapping[str, Any]) -> Any:
    linear, angular = (_vector(values.get(f"{which}_velocity") or {}) for which in ("linear", "angular"))
    pose = ros.geometry_msgs__msg__PoseWithCovariance(_pose(values.get("pose") or {}), np.zeros(36))
    twist = ros.geometry_msgs__msg__TwistWithCovariance(ros.geometry_msgs__msg__Twist(linear, angular), np.zeros(36))
    return ros.nav_msgs__msg__Odometry(_header(values), str(values.get("body_frame_id", "")), pose, twist)


def _vector(values: Mapping[str, Any]) -> Any:
    return ros.geometry_msgs__msg__Vector3(*(float(values.get(axis, 0.0)) for axis in "xyz"))


def _rotation(values: Mapping[str, Any]) -> Any:
    return ros.geometry_msgs__msg__Quaternion(*(float(values.get(axis, 0.0)) for axis in "xyzw"))


def _pose(values: Mapping[str, Any]) -> Any:
    place = _vector(values.get("position") or {})
    point = ros.geometry_msgs__msg__Point(place.x, place.y, place.z)
    return ros.geometry_msgs__msg__Pose(point, _rotation(values.get("orientation") or {}))


def _calibration(values: Mapping[str, Any]) -> Any:
    k, r, p = (_doubles(values, name, count) for name, count in (("K", 9), ("R", 9), ("P", 12)))
    d, region = _doubles(values, "D", None), ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, False)
    height, width = _uint32(values, "height"), _uint32(values, "width")
    model = str(values.get("distortion_model", ""))
    return ros.sensor_msgs__msg__CameraInfo(_header(values), height, width, model, d, k, r, p, 0, 0, region)


def _transforms(values: Mapping[str, Any]) -> Any:
    return ros.tf2_msgs__msg__TFMessage([_transform(one) for one in values.get("transforms", ())])


def _transform(values: Mapping[str, Any]) -> Any:
    header = _header({**values, "frame_id": values.get("parent_frame_id", "")})
    vector, rotation = _vector(values.get("translation") or {}), _rotation(values.get("rotation") or {})
    pose = ros.geometry_msgs__msg__Transform(vector, rotation)
    return ros.geometry_msgs__msg__TransformStamped(header, str(values.get("child_frame_id", "")), pose)


def _uint32(values: Mapping[str, Any], name: str) -> int:
    number = int(values.get(name, 0))
    if not 0 <= number < 2**32:
        raise _malformed(f"{name} is no number of 32 bits")
    return number


def _doubles(values: Mapping[str, Any], name: str, count: int | None) -> Any:
    numbers = np.array(values.get(name, values.get(name.lower(), ())), dtype=np.float64)
    if numbers.ndim != 1 or (count is not None and numbers.size not in (0, count)):
        raise _malformed(f"{name} has not {count} numbers")
    return numbers if count is None or numbers.size else np.zeros(count)


_FOXGLOVE: Final[Mapping[str, tuple[str, Fields, Callable[[Mapping[str, Any]], Any]]]] = {
    "foxglove.CompressedImage": (messages.COMPRESSED_IMAGE, _COMPRESSED_IMAGE, _compressed_image),
    "foxglove.CompressedVideo": (messages.COMPRESSED_IMAGE, _COMPRESSED_VIDEO, _compressed_image),
    "foxglove.RawImage": (messages.IMAGE, _RAW_IMAGE, _raw_image),
    "foxglove.PointCloud": (messages.POINT_CLOUD, _POINT_CLOUD, _point_cloud),
    "foxglove.CompressedPointCloud": (messages.FOXGLOVE_CLOUD, _PACKED_CLOUD, _packed_cloud),
    "foxglove.Odometry": (messages.ODOMETRY, _ODOMETRY, _odometry),
    "foxglove.CameraCalibration": (messages.CAMERA_INFO, _CALIBRATION, _calibration),
    "foxglove.FrameTransforms": (messages.TF, _message(transforms=[_TRANSFORM]), _transforms),
    "foxglove.FrameTransform": (messages.TF, _TRANSFORM, lambda values: _transforms({"transforms": [values]})),
}


def _from_foxglove(schema: str, read: Callable[[bytes, Fields], Mapping[str, Any]]) -> Translation:
    type_name, fields, build = _FOXGLOVE[schema]

    def convert(data: bytes) -> bytes:
        try:
            return messages.serialized(build(read(data, fields)), type_name)
        except (TypeError, ValueError, AttributeError, OverflowError, RecursionError, struct.error) as error:
            raise _malformed(f"not a {schema}") from error

    return Translation(type_name, convert)


def _json(data: bytes, _: Fields) -> dict[str, Any]:
    if len(data) > MAX_JSON_BYTES:
        raise DecodeError(Refusal.MESSAGE_TOO_LARGE, f"a message in JSON has at most {MAX_JSON_BYTES} bytes")
    values = json.loads(data)
    if not isinstance(values, dict):
        raise _malformed("a message in JSON is no object")
    try:
        return {**values, "data": base64.b64decode(values["data"], validate=True)} if "data" in values else values
    except binascii.Error as error:
        raise _malformed("the data of a message in JSON is not base64") from error


BY_SCHEMA: Final = {
    **_ros_1(),
    **{("protobuf", schema): _from_foxglove(schema, _protobuf) for schema in _FOXGLOVE},
    **{("json", schema): _from_foxglove(schema, _json) for schema in _FOXGLOVE},
}
"""Every translation, by the encoding and the schema of a channel."""

TRANSLATIONS: Final = tuple(BY_SCHEMA.values())
"""Every translation, by its number."""

_NUMBERS: Final = {schema: number for number, schema in enumerate(BY_SCHEMA)}
