"""ROS 2 without ROS: messages in CDR packed by hand with struct, sensor drivers whose keys, tokens and attachments are
put together as they were on the wire between rmw_zenoh_cpp 0.6.7 and a session, and the session and router of
rmw_zenoh as its own files make them. The defaults are from
`rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_{SESSION,ROUTER}_CONFIG.json5` of https://github.com/ros2/rmw_zenoh, commit
076f2e715b54132d00a605e1c45e13401d5e7342 (Apache-2.0). Here stands only what differs from Zenoh's own defaults;
values that a file repeats from them are left out.

From `rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_{SESSION,ROUTER}_CONFIG.json5` of https://github.com/ros2/rmw_zenoh, commit
076f2e715b54132d00a605e1c45e13401d5e7342 (Apache-2.0). Here stands only what differs from Zenoh's own defaults; values
that a file repeats from them are left out.
"""

from __future__ import annotations

import json
import struct
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import xxhash
import zenoh

from coec.calibration.types import CameraFrame, Frame, LidarFrame
from coec.io.images import encode_jpeg
from coec.io.ros import message_encoding
from coec.io.zenoh.player import stream_of
from coec.io.zenoh.ros_node import has_subscribers
from support.fake_worker import wait_until

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


def velodyne_packet(azimuth_cdeg: int, model: int = 0x22, distance_m: float = 5.0, time_us: int = 0) -> bytes:
    """A packet of a VLP-16: 12 blocks of twice 16 beams, all at one distance, each with its own intensity."""
    blocks = b"".join(
        struct.pack("<HH", 0xEEFF, (azimuth_cdeg + 40 * block) % 36_000)
        + b"".join(struct.pack("<HB", round(distance_m / 0.002), beam) for beam in range(32))
        for block in range(12)
    )
    return blocks + struct.pack("<IBB", time_us, 0x37, model)


def velodyne_scan(count: int = 75, *, stamped_first: bool = False, packet: bytes | None = None) -> bytes:
    """A `VelodyneScan` of packets 1.327 ms apart, the last or the first of which has the stamp of its header."""
    begin_ns = STAMP_NS if stamped_first else STAMP_NS - (count - 1) * 1_327_000
    packer = Packer().header("velodyne").put("I", count)
    for number in range(count):
        sec, nsec = divmod(begin_ns + number * 1_327_000, 10**9)
        packer.put("i", sec).put("I", nsec)
        packer.body += velodyne_packet(480 * number, time_us=1327 * number) if packet is None else packet
    return packer.done()


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


HASHES = {
    "CompressedImage": "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    "Image": "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "PointCloud2": "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "Odometry": "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
}
"""Of the types, as rclpy of Kilted gives them."""

PACKAGES = {"Odometry": "nav_msgs"}
TYPES = {"camera": "CompressedImage", "lidar": "PointCloud2", "ego": "Odometry"}


def cdr_message(frame: Frame) -> bytes:
    """The message that holds a frame."""
    match frame:
        case CameraFrame():
            return message_encoding.encode_image(frame)[1]
        case LidarFrame():
            return message_encoding.encode_cloud(frame)
        case _:
            return message_encoding.encode_motion(frame)[1]


def type_chunks(type_name: str) -> str:
    """The last two chunks of a key."""
    return f"{PACKAGES.get(type_name, 'sensor_msgs')}::msg::dds_::{type_name}_/{HASHES[type_name]}"


class RosDriver:
    """One publisher of rmw_zenoh; a node of its own. `number` tells those of a session apart."""

    def __init__(self, session: zenoh.Session, topic: str, type_name: str, number: int, node: str = "driver") -> None:
        zid, mangled = session.info.zid(), topic.replace("/", "%")
        token = f"@ros2_lv/0/{zid}/{number}/{number + 1}/MP/%/%/{node}/{mangled}/{type_chunks(type_name)}/2::,5:,:,:,,"
        self.gid = xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
        self.publisher = session.declare_publisher(
            f"0{topic}/{type_chunks(type_name)}", congestion_control=zenoh.CongestionControl.BLOCK
        )
        self._token = session.liveliness().declare_token(token)
        self._sequence = 0

    def put(self, payload: bytes, number: int | None = None) -> None:
        """`number` instead of the next one."""
        self._sequence = self._sequence + 1 if number is None else number
        attachment = struct.pack("<qqB16s", self._sequence, time.time_ns(), 16, self.gid)
        self.publisher.put(payload, attachment=attachment)

    def sends(self, payload: bytes) -> bool:
        """Puts it; False, for a loop that waits for what comes of it."""
        self.put(payload)
        return False

    def close(self) -> None:
        self._token.undeclare()
        self.publisher.undeclare()


class BridgedTopic:
    """One topic of DDS behind a zenoh-bridge-ros2dds."""

    def __init__(self, session: zenoh.Session, topic: str) -> None:
        self.publisher = session.declare_publisher(topic[1:], congestion_control=zenoh.CongestionControl.BLOCK)

    def put(self, payload: bytes) -> None:
        self.publisher.put(payload)

    def close(self) -> None:
        self.publisher.undeclare()


class RosSensors:
    """Camera, LiDAR and ego-motion of a pair, on these topics."""

    def __init__(self, session: zenoh.Session, topics: Mapping[str, str], middleware: str) -> None:
        self.sent: Counter[str] = Counter()
        self._drivers: dict[str, RosDriver | BridgedTopic] = {
            stream: RosDriver(session, topic, TYPES[stream], 10 * number)
            if middleware == "rmw_zenoh"
            else BridgedTopic(session, topic)
            for number, (stream, topic) in enumerate(topics.items())
        }
        wait_until(lambda: all(has_subscribers(one.publisher) for one in self._drivers.values()), "somebody listens")

    def send(self, frame: Frame) -> None:
        self._drivers[stream_of(frame)].put(cdr_message(frame))
        self.sent[stream_of(frame)] += 1

    def close(self) -> None:
        for driver in self._drivers.values():
            driver.close()


_BOTH: Mapping[str, object] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "timestamping/enabled": {"router": True, "peer": True, "client": True},
    "queries_default_timeout": 600_000,
    "transport/unicast/open_timeout": 60_000,
    "transport/unicast/accept_timeout": 60_000,
    "transport/unicast/accept_pending": 10_000,
    "transport/unicast/max_sessions": 10_000,
    "transport/link/tx/lease": 60_000,
    "transport/link/tx/keep_alive": 2,
    "transport/shared_memory/enabled": False,
    "adminspace/enabled": True,
}

RMW_SESSION: Mapping[str, object] = {
    **_BOTH,
    "mode": "peer",
    "connect/endpoints": ["tcp/localhost:7447"],
    "listen/endpoints": ["tcp/localhost:0"],
    "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
}
"""Of every node."""

RMW_ROUTER: Mapping[str, object] = {
    **_BOTH,
    "mode": "router",
    "listen/endpoints": ["tcp/[::]:7447"],
    "routing/router/peers_failover_brokering": False,
}
"""Of `rmw_zenohd`, the router of a vehicle."""


def rmw_settings(defaults: Mapping[str, object], changed: Mapping[str, object]) -> zenoh.Config:
    """Settings of a session, some of them other than the file says."""
    made = zenoh.Config()
    for key, value in {**defaults, **changed}.items():
        made.insert_json5(key, json.dumps(value))
    return made


@contextmanager
def rmw_node(endpoint: str) -> Iterator[zenoh.Session]:
    """The session of a node that connects to the router at this endpoint."""
    with zenoh.open(rmw_settings(RMW_SESSION, {"connect/endpoints": [endpoint]})) as session:
        yield session


@contextmanager
def rmw_router(endpoint: str) -> Iterator[zenoh.Session]:
    """The router, at this endpoint."""
    with zenoh.open(rmw_settings(RMW_ROUTER, {"listen/endpoints": [endpoint]})) as session:
        yield session
