"""Clouds that messages hold in another form than points, as `PointCloud2`: clouds packed by point_cloud_transport
(`draco`, `cloudini`, `zlib`, `zstd`) or for Foxglove (`draco`), and scans of Velodyne's packets. They are read from
recordings only.

Each form is decoded by the library of an optional extra, apart from zlib and zstd. What a library would allocate by the
numbers in a message is checked before it sees them.
"""

from __future__ import annotations

import importlib.util
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_humble as ros
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__PointField as PointField

from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal
from coec.io.ros import messages

MAX_NAME: Final = 255
"""Most bytes of the name of a format."""


def cloud_of(type_name: str, payload: bytes, limits: LimitsConfig) -> PointCloud2:
    """The cloud in a message in CDR of one of the `TYPES`.

    Raises:
        DecodeError: `message_malformed`, `frame_id_invalid`, `cloud_fields`, `cloud_too_large`, `transform_invalid`;
            `message_type`: the format is not read, or its optional extra is not installed.
    """
    return TYPES[type_name](payload, limits)


def _malformed(what: str) -> DecodeError:
    return DecodeError(Refusal.MESSAGE_MALFORMED, what)


def _require(module: str, extra: str, otherwise: str) -> None:
    if importlib.util.find_spec(module) is None:
        text = f"they are decoded with the optional extra `{extra}`: pip install 'coec[{extra}]'; or {otherwise}"
        raise DecodeError(Refusal.MESSAGE_TYPE, text)


# --- packed clouds ----------------------------------------------------------------------------------------------------

UNPACK: Final = (
    "unpack them with `ros2 run point_cloud_transport republish` (of a file packed by Cloudini, "
    "`cloudini_rosbag_converter -d`), and take the topic of PointCloud2"
)


def _of_transport(payload: bytes, limits: LimitsConfig) -> PointCloud2:
    messages.check_cloud_fields(payload)
    message = messages.deserialized_by_name(messages.COMPRESSED_CLOUD, payload)
    count, step = message.height * message.width, message.point_step
    size = max(message.row_step * message.height, count * step)
    if count > limits.max_points or size > limits.max_message_bytes:
        text = f"a cloud of {count} points would unpack to {size} bytes; {limits.max_points} points are read at most"
        raise DecodeError(Refusal.CLOUD_TOO_LARGE, text)
    form, packed = str(message.format).strip().lower(), message.compressed_data.tobytes()
    fields, row_step = message.fields, message.row_step
    if form not in ("draco", *FORMATS):
        known = ", ".join(("draco", *FORMATS))
        text = f"a cloud of the format {str(message.format)[:MAX_NAME]!a}: {known} are read; or {UNPACK}"
        raise DecodeError(Refusal.MESSAGE_TYPE, text)
    if form == "draco":
        data, fields = _interleaved(_draco_columns(packed, count), message)
    else:
        data = np.frombuffer(FORMATS[form](packed, size), np.uint8)
    if form in ("draco", "cloudini"):
        row_step = message.width * step
    return PointCloud2(
        message.header, message.height, message.width, fields, message.is_bigendian, step, row_step, data, True
    )


def _of_zlib(packed: bytes, size: int) -> bytes:
    try:
        # zlib takes 0 for no limit.
        return zlib.decompressobj().decompress(packed, max(size, 1))
    except zlib.error as error:
        raise _malformed("the cloud is not packed by zlib, or damaged") from error


def _of_zstd(packed: bytes, size: int) -> bytes:
    try:
        if zstandard.frame_content_size(packed) > size:
            raise _malformed(f"the cloud would unpack to more than its {size} bytes")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    except zstandard.ZstdError as error:
        raise _malformed("the cloud is not packed by zstd, or damaged") from error


_CLOUDINI_BINARY: Final = re.compile(rb"CLOUDINI_V02(.{12})", re.DOTALL)
_CLOUDINI_TEXT: Final = re.compile(rb"CLOUDINI_V0[3-9]\n([^\0]{1,65536})\0", re.DOTALL)
_CLOUDINI_SIZE: Final = re.compile(rb"^(width|height|point_step): *(\d{1,10})\s*$", re.MULTILINE)


def _of_cloudini(packed: bytes, size: int) -> bytes:
    """Source: cloudini_lib, `header.hpp`: a cloud has its own width, height and step, by which a decoder allocates."""
    binary, text = _CLOUDINI_BINARY.match(packed), _CLOUDINI_TEXT.match(packed)
    if binary is not None:
        numbers = list(struct.unpack("<III", binary[1]))
    else:
        numbers = [] if text is None else [int(number) for _, number in _CLOUDINI_SIZE.findall(text[1])]
    if len(numbers) != 3:
        raise _malformed("the cloud is not packed by Cloudini (versions 2 to 5), or damaged")
    if numbers[0] * numbers[1] * numbers[2] > size:
        raise _malformed(f"the cloud would unpack to more than its {size} bytes")
    _require("pureini", "cloudini", UNPACK)
    import pureini

    try:
        return bytes(pureini.PointcloudDecoder().decode(packed)[0])
    except (RuntimeError, ValueError, OverflowError) as error:
        raise _malformed(f"the cloud packed by Cloudini is damaged: {error}") from error


FORMATS: Final[Mapping[str, Callable[[bytes, int], bytes]]] = {
    "zlib": _of_zlib,
    "zstd": _of_zstd,
    "cloudini": _of_cloudini,
}
"""Decoders by the `format` of a message, beside `draco`."""

# --- Draco ------------------------------------------------------------------------------------------------------------

_POSITION, _FLOAT64 = 0, 10
"""Of Draco's `GeometryAttribute::Type` and `DataType`."""


@dataclass(frozen=True, slots=True)
class _Column:
    """One component of an attribute of a Draco cloud.

    Attributes:
        values: (N,); float64 comes as float32 from the library.
    """

    name: str
    kind: int
    data_type: int
    values: NDArray[Any]


class _DracoHead:
    """What precedes the points in a Draco bitstream, by its specification ("Draco Bitstream Specification", sections
    Header, Metadata, Attributes)."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 11
        magic, _, _, kind, _, flags = struct.unpack_from("<5sBBBBH", data.ljust(11, b"\0"))
        if magic != b"DRACO" or kind != 0:
            raise _malformed("the cloud is not packed by Draco, or it is a mesh")
        if flags & 0x8000:
            for _ in range(self._varint(messages.MAX_CLOUD_FIELDS)):
                self._varint(2**32)
                self._entries()
            self._entries()
        self.points = int.from_bytes(self._bytes(4), "little")
        if self._bytes(1) != b"\1":
            raise _malformed("the cloud packed by Draco has several groups of attributes")
        self.components = 0
        for _ in range(self._varint(messages.MAX_CLOUD_FIELDS)):
            self.components += self._bytes(4)[2]
            self._varint(2**32)

    def _entries(self) -> None:
        for _ in range(self._varint(messages.MAX_CLOUD_FIELDS)):
            self._bytes(self._bytes(1)[0])
            self._bytes(self._varint(len(self._data)))
        self._varint(0)  # no metadata below it

    def _bytes(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise _malformed("the cloud packed by Draco is cut off")
        self._at += size
        return self._data[self._at - size : self._at]

    def _varint(self, most: int) -> int:
        value = 0
        for shift in range(0, 35, 7):
            byte = self._bytes(1)[0]
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
        if value > most:
            raise _malformed("the cloud packed by Draco has more attributes or metadata than a cloud can have")
        return value


def _draco_columns(packed: bytes, count: int) -> list[_Column]:
    """The components of the attributes of a cloud of at most `count` points, in their order."""
    head = _DracoHead(packed)
    if head.points > count or head.components > messages.MAX_CLOUD_FIELDS:
        raise _malformed(f"the cloud packed by Draco has {head.points} points; its message allows {count}")
    _require("DracoPy", "draco", UNPACK)
    import DracoPy

    try:
        cloud = DracoPy.decode(packed)
    except (DracoPy.FileTypeException, ValueError, RuntimeError, MemoryError) as error:
        raise _malformed(f"the cloud packed by Draco is damaged: {error}") from error
    return [
        _Column(str(one["name"] or ""), int(one["attribute_type"]), int(one["data_type"]), values)
        for one in cloud.attributes
        for values in np.asarray(one["data"]).reshape(head.points, -1).T
    ]


_DTYPES: Final = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}
"""By `PointField.datatype`."""


def _interleaved(columns: list[_Column], message: Any) -> tuple[NDArray[np.uint8], list[PointField]]:
    """The data of a packed cloud, and its fields. Each field is an attribute, in this order (`convertPC2toDraco` of
    draco_point_cloud_transport); a colour has a component for each of its bytes. Fields of 64 bits are left out,
    because the library gives them with 32."""
    count, step = message.height * message.width, message.point_step
    data, fields, rest = np.zeros((count, step), np.uint8), [], iter(columns)
    for field in message.fields:
        column = next(rest, None)
        form = _DTYPES.get(field.datatype)
        if column is None or form is None or field.count != 1 or len(column.values) != count:
            raise _malformed("the cloud packed by Draco does not have the points and fields of its message")
        parts, size = [column.values], np.dtype(form).itemsize
        if column.kind == 2:  # COLOR
            parts += [one.values for one, _ in zip(rest, range(size - 1), strict=False)]
            form = "u1"
        if field.offset + size > step:
            raise DecodeError(Refusal.CLOUD_FIELDS, f"a field lies outside of the {step} bytes of a point")
        if column.data_type == _FLOAT64:
            continue
        for at, part in enumerate(parts):
            written = part.astype(form).view(np.uint8).reshape(count, -1)
            data[:, field.offset + at : field.offset + at + written.shape[1]] = written
        fields.append(field)
    return data.ravel(), fields


def _of_foxglove(payload: bytes, limits: LimitsConfig) -> PointCloud2:
    """Source: foxglove-sdk, `CompressedPointCloud`: the position, and attributes by the names in the metadata."""
    messages.check_header(payload)
    message = messages.deserialized_by_name(messages.FOXGLOVE_CLOUD, payload)
    place, turn = message.pose.position, message.pose.orientation
    if any(getattr(part, axis) for part in (place, turn) for axis in "xyz"):
        raise DecodeError(Refusal.TRANSFORM_INVALID, "the cloud has a pose in its frame, which is not applied")
    if message.format.strip().lower() != "draco":
        text = f"a cloud of the format {message.format[:MAX_NAME]!a}: draco is read"
        raise DecodeError(Refusal.MESSAGE_TYPE, text)
    columns = _draco_columns(message.data.tobytes(), limits.max_points)
    positions = [one.values for one in columns if one.kind == _POSITION]
    others = [one for one in columns if one.kind != _POSITION and one.data_type != _FLOAT64]
    points = {one.name: one.values for one in others if one.name} | dict(zip("xyz", positions, strict=False))
    forms = [(name, "<u4" if values.dtype.kind == "u" else "<f4") for name, values in points.items()]
    rows = np.zeros(len(columns[0].values) if columns else 0, forms)
    for name, values in points.items():
        rows[name] = values
    fields = [PointField(name, 4 * at, 6 if form == "<u4" else 7, 1) for at, (name, form) in enumerate(forms)]
    step, data = 4 * len(points), np.frombuffer(rows.tobytes(), np.uint8)
    header = ros.std_msgs__msg__Header(message.timestamp, message.frame_id)
    return PointCloud2(header, 1, len(rows), fields, False, step, step * len(rows), data, True)


# --- packets ----------------------------------------------------------------------------------------------------------

MAX_PACKETS: Final = 4096
"""Most packets of a scan; a turn of the largest model at 5 Hz has some 2,500."""

_SCAN_FIELDS: Final = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7), ("ring", 22, 2))
"""Name, offset and `PointField.datatype` of what is read of the points of velodyne-decoder."""

CONVERT_SCANS: Final = (
    "convert them with velodyne_pointcloud's velodyne_transform_node, and take its topic of PointCloud2"
)


def _of_velodyne(payload: bytes, limits: LimitsConfig) -> PointCloud2:
    """Points timed since the stamp of the message."""
    del limits
    count = messages.check_header(payload).number()
    if not 0 < count <= MAX_PACKETS:
        raise _malformed(f"{count} packets; a scan has up to {MAX_PACKETS}")
    _require("velodyne_decoder", "velodyne", CONVERT_SCANS)
    import velodyne_decoder as velodyne

    message = messages.deserialized_by_name(messages.VELODYNE_SCAN, payload)
    packets = [
        velodyne.VelodynePacket(each.stamp.sec + each.stamp.nanosec * 1e-9, each.data.tobytes())
        for each in message.packets
    ]
    try:
        stamps, points = velodyne.ScanDecoder(velodyne.Config()).decode(velodyne.PacketVector(packets), True)
    except (RuntimeError, ValueError, IndexError) as error:
        raise _malformed(f"the packets of Velodyne are not read: {error}") from error
    # The library counts from the last packet, the message is stamped by its first or last one.
    stamp = message.header.stamp
    points["time"] += np.float32(stamps.host - (stamp.sec + stamp.nanosec * 1e-9))
    fields = [PointField(name, offset, kind, 1) for name, offset, kind in _SCAN_FIELDS]
    step, data = points.dtype.itemsize, np.frombuffer(points.tobytes(), np.uint8)
    return PointCloud2(message.header, 1, len(points), fields, False, step, step * len(points), data, True)


TYPES: Final[Mapping[str, Callable[[bytes, LimitsConfig], PointCloud2]]] = {
    messages.COMPRESSED_CLOUD: _of_transport,
    messages.FOXGLOVE_CLOUD: _of_foxglove,
    messages.VELODYNE_SCAN: _of_velodyne,
}
"""The types that are read, with their decoders."""
