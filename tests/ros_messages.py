"""ROS 2 messages in CDR, packed by hand with struct: what no encoder of ours had a part in."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from coec.adapters.images.codec import encode_jpeg

STAMP_S, STAMP_REST_NS = 1_700_000_000, 123_456_789
STAMP_NS = STAMP_S * 10**9 + STAMP_REST_NS
JPEG = encode_jpeg(np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8))

Columns = list[tuple[str, str, list[float]]]
"""Of a cloud: name, NumPy type, values."""

CODES = {"i1": 1, "u1": 2, "<i2": 3, "<u2": 4, "<i4": 5, "<u4": 6, "<f4": 7, "<f8": 8}
"""Of `sensor_msgs/PointField`, by NumPy type."""


class Packer:
    """CDR, little-endian, packed by hand: alignment counts from behind the 4 bytes of encapsulation."""

    def __init__(self) -> None:
        self.body = bytearray()

    def put(self, form: str, *values: float) -> Packer:
        for value in values:
            self.body += bytes(-len(self.body) % struct.calcsize("<" + form))
            self.body += struct.pack("<" + form, value)
        return self

    def text(self, text: str) -> Packer:
        self.put("I", len(text.encode()) + 1)
        self.body += text.encode() + b"\0"
        return self

    def octets(self, data: bytes, claimed: int | None = None) -> Packer:
        self.put("I", len(data) if claimed is None else claimed)
        self.body += data
        return self

    def header(self, frame_id: str, sec: int = STAMP_S, nsec: int = STAMP_REST_NS) -> Packer:
        return self.put("i", sec).put("I", nsec).text(frame_id)

    def done(self) -> bytes:
        return b"\x00\x01\x00\x00" + bytes(self.body)


def compressed_image(data: bytes = JPEG, form: str = "jpeg", **header: Any) -> bytes:
    return Packer().header(**({"frame_id": "camera"} | header)).text(form).octets(data).done()


def raw_image(encoding: str, width: int, height: int, step: int, data: bytes, *, big: bool = False) -> bytes:
    packer = Packer().header("camera").put("I", height, width).text(encoding)
    return packer.put("B", big).put("I", step).octets(data).done()


def cloud(
    fields: list[tuple[str, int, int]],
    data: bytes,
    width: int,
    point_step: int,
    *,
    height: int = 1,
    row_step: int | None = None,
    big: bool = False,
    claimed: int | None = None,
    claimed_fields: int | None = None,
    counts: int = 1,
    sec: int = STAMP_S,
    nsec: int = STAMP_REST_NS,
) -> bytes:
    packer = Packer().header("lidar", sec, nsec).put("I", height, width)
    packer.put("I", len(fields) if claimed_fields is None else claimed_fields)
    for name, offset, datatype in fields:
        packer.text(name).put("I", offset).put("B", datatype).put("I", counts)
    packer.put("?", big).put("I", point_step, width * point_step if row_step is None else row_step)
    return packer.octets(data, claimed).put("?", False).done()


def packed_cloud(columns: Columns, *, big: bool = False, **options: Any) -> bytes:
    """A cloud of one row, without padding, its columns in the order given."""
    fields, formats, offset = [], [], 0
    for name, form, _ in columns:
        fields.append((name, offset, CODES[form]))
        formats.append((name, form.replace("<", ">") if big else form))
        offset += np.dtype(form).itemsize
    rows = np.zeros(len(columns[0][2]), formats)
    for name, _, values in columns:
        rows[name] = values
    return cloud(fields, rows.tobytes(), len(rows), offset, big=big, **options)


def twist(linear: tuple[float, ...] = (1.5, 0.0, -0.25), angular: tuple[float, ...] = (0.0, 0.5, 0.125)) -> bytes:
    return Packer().header("base_link").put("d", *linear, *angular).done()


def odometry(child: str = "base_link") -> bytes:
    packer = Packer().header("odom").text(child).put("d", *range(7), *[0.0] * 36)
    return packer.put("d", 1.5, 0.0, -0.25, 0.0, 0.5, 0.125, *[0.0] * 36).done()


def twist_with_covariance() -> bytes:
    packer = Packer().header("base_link").put("d", 1.5, 0.0, -0.25, 0.0, 0.5, 0.125)
    return packer.put("d", *[0.0] * 36).done()


def imu(angular: tuple[float, ...] = (0.0, 0.5, 0.125), known: float = 0.0, frame_id: str = "imu_link") -> bytes:
    packer = Packer().header(frame_id).put("d", 0.0, 0.0, 0.0, 1.0).put("d", *[0.0] * 9)
    packer.put("d", *angular).put("d", known, *[0.0] * 8)
    return packer.put("d", 0.0, 0.0, 9.81).put("d", *[0.0] * 9).done()


PoseValues = tuple[float, float, float, float, float, float, float]
"""x y z, quaternion x y z w."""


def transforms(*joints: tuple[str, str, int, PoseValues], claimed: int | None = None) -> bytes:
    """A `TFMessage`: parent, child, stamp in ns, pose of the child in the parent."""
    packer = Packer().put("I", len(joints) if claimed is None else claimed)
    for parent, child, stamp_ns, pose in joints:
        packer.header(parent, *divmod(stamp_ns, 10**9)).text(child).put("d", *pose)
    return packer.done()
