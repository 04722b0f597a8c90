"""Recorded messages as if they had been recorded later."""

from __future__ import annotations

import struct
from typing import Any, cast

import numpy as np
import pytest
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.io.ros.message_decoding import decode
from coec.io.ros.messages import COMPRESSED_IMAGE, ODOMETRY, POINT_CLOUD, TF
from coec.io.ros.topics import TopicMessage, shifted
from support import ros as ros_messages
from support.recordings import STORE, TREE
from support.ros import STAMP_NS, STAMP_S, packed_cloud

LATER_NS = 86_400 * 10**9 + 900_000_000
LATER_S, LATER_NSEC = divmod(STAMP_NS + LATER_NS, 10**9)
XYZ = [("x", "<f4", [1.0, 2.0]), ("y", "<f4", [0.0, 0.0]), ("z", "<f4", [0.0, 0.0])]


def later(type_name: str, data: bytes, shift_ns: int = LATER_NS) -> bytes:
    moved = shifted(TopicMessage(7, "/topic", type_name, data), shift_ns)
    assert (moved.stamp_ns, moved.topic, moved.type_name) == (7 + shift_ns, "/topic", type_name)
    return moved.data


@pytest.mark.parametrize(
    ("type_name", "data"),
    [
        (COMPRESSED_IMAGE, ros_messages.compressed_image()),
        (ODOMETRY, ros_messages.odometry()),
        (POINT_CLOUD, packed_cloud(XYZ)),
    ],
)
def test_of_a_message_with_a_header_eight_bytes_change(type_name: str, data: bytes) -> None:
    assert later(type_name, data) == data[:4] + struct.pack("<iI", LATER_S, LATER_NSEC) + data[12:]
    assert later(type_name, data, 0) is data


def test_the_order_of_the_bytes_stays() -> None:
    data = b"\x00\x00\x00\x00" + struct.pack(">iI", STAMP_S, 5) + b"rest"
    assert later(COMPRESSED_IMAGE, data, 10**9) == b"\x00\x00\x00\x00" + struct.pack(">iI", STAMP_S + 1, 5) + b"rest"


def test_every_transform_is_later() -> None:
    data = bytes(STORE.serialize_cdr(ros.tf2_msgs__msg__TFMessage(TREE), TF))
    joints = cast("Any", STORE.deserialize_cdr(later(TF, data), TF)).transforms
    assert {(j.header.stamp.sec, j.header.stamp.nanosec) for j in joints} == {(86_400, 900_000_000)}
    assert [j.child_frame_id for j in joints] == [j.child_frame_id for j in TREE]


@pytest.mark.parametrize("unit_s", [1.0, 1e-9])
def test_points_that_carry_a_clocks_time_move_with_their_stamp(unit_s: float) -> None:
    times = [(STAMP_NS * 1e-9 + 0.01) / unit_s, (STAMP_NS * 1e-9 + 0.05) / unit_s]
    data = packed_cloud([*XYZ, ("timestamp", "<f8", times)])
    frame = decode(POINT_CLOUD, later(POINT_CLOUD, data), LimitsConfig())
    assert isinstance(frame, LidarFrame)
    assert frame.stamp_ns == STAMP_NS + LATER_NS
    assert frame.time_offset_s is not None
    np.testing.assert_allclose(frame.time_offset_s, [0.01, 0.05], atol=1e-5)


@pytest.mark.parametrize("unit_s", [1.0, 1e-9])
def test_points_whose_cloud_has_no_stamp_move_alone(unit_s: float) -> None:
    times = [(STAMP_NS * 1e-9) / unit_s, (STAMP_NS * 1e-9 + 0.04) / unit_s]
    data = later(POINT_CLOUD, packed_cloud([*XYZ, ("timestamp", "<f8", times)], sec=0, nsec=0))
    assert data[4:12] == bytes(8)
    frame = decode(POINT_CLOUD, data, LimitsConfig())
    assert isinstance(frame, LidarFrame)
    assert frame.stamp_ns == pytest.approx(STAMP_NS + LATER_NS, abs=1000)


def test_a_header_without_a_stamp_stays_without() -> None:
    data = b"\x00\x01\x00\x00" + bytes(8) + b"rest"
    assert later(COMPRESSED_IMAGE, data) == data


def test_times_since_the_stamp_stay() -> None:
    data = packed_cloud([*XYZ, ("time", "<f8", [0.0, 0.1])])
    assert later(POINT_CLOUD, data)[12:] == data[12:]


@pytest.mark.parametrize("type_name", ["std_msgs/msg/String", "acme_msgs/msg/Wheel"])
def test_what_has_no_header_or_is_not_known_keeps_its_bytes(type_name: str) -> None:
    assert later(type_name, b"\x00\x01\x00\x00anything") == b"\x00\x01\x00\x00anything"


@pytest.mark.fault("a recorded message that ends within its header", "it is refused when it would be moved to now")
@pytest.mark.parametrize(
    ("type_name", "data"),
    [
        (COMPRESSED_IMAGE, b"\x00\x01\x00\x00\x01"),
        (COMPRESSED_IMAGE, b"\x00\x07\x00\x00" + bytes(8)),
        (TF, b"\x00\x01\x00\x00\xff\xff\xff\xff"),
        (POINT_CLOUD, b"\x00\x01\x00\x00" + bytes(9)),
        (POINT_CLOUD, ros_messages.cloud([("time", 90, 8)], bytes(24), 2, 12)),
    ],
    ids=range(5),
)
def test_a_message_that_is_none_is_refused(type_name: str, data: bytes) -> None:
    with pytest.raises(DecodeError):
        later(type_name, data)


@pytest.mark.parametrize("shift_ns", [-STAMP_NS - 1, 2**31 * 10**9])
def test_no_stamp_leaves_what_ros_can_say(shift_ns: int) -> None:
    with pytest.raises(DecodeError, match="1970"):
        later(ODOMETRY, ros_messages.odometry(), shift_ns)
