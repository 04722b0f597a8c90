"""Messages of ROS 2 against rclpy itself: what coec writes it reads, what it writes coec reads, and the types are the
same to the hash."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, FramePair, ImageFormat, LidarFrame, Rig
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry.cameras import MODELS, build
from coec.io.mcap.windows import WindowWriter
from coec.io.ros import message_decoding, message_encoding, messages
from coec.io.ros.message_encoding import DiagnosticLevel, DiagnosticStatus
from peers.environments import Peer, peer
from support.ros import JPEG, STAMP_NS

LIMITS = LimitsConfig()
STORE = get_typestore(Stores.ROS2_HUMBLE)

T_CAMERA_LIDAR = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1]], dtype=np.float64)
SWEEP = LidarFrame(
    STAMP_NS,
    "lidar",
    np.random.default_rng(3).normal(size=(101, 3)).astype(np.float32),
    intensity=np.linspace(0, 1, 101, dtype=np.float32),
    ring=np.arange(101, dtype=np.uint16),
    time_offset_s=np.linspace(-0.1, 0, 101, dtype=np.float32),
)
MOTION = EgoMotion(STAMP_NS, "base_link", (12.5, -1e-9, 0.0), (1 / 3, 0.0, -0.25))
STATUSES = [
    DiagnosticStatus(DiagnosticLevel.OK, "coec: front_calibration", "", "camera-7", {}),
    DiagnosticStatus(
        DiagnosticLevel.STALE, "coec: rear_calibration", "σ ± 0.1°", "", {"mi": "0.5", "drift": "", "ß": "0"}
    ),
]

FRAMES = {messages.COMPRESSED_IMAGE, messages.IMAGE, messages.POINT_CLOUD, messages.ODOMETRY, messages.IMU}

IMAGES = [
    EncodedImage(ImageFormat.JPEG, 64, 48, JPEG),
    EncodedImage(ImageFormat.RGB8, 2, 3, bytes(range(18))),
    EncodedImage(ImageFormat.MONO8, 3, 3, bytes(range(9))),
]


@pytest.fixture(scope="module")
def rclpy() -> Iterator[Peer]:
    with peer("ros2", "rclpy_worker.py") as rclpy:
        yield rclpy


def known(rclpy: Peer, type_name: str) -> str:
    """The type, where that ROS has it: tf2_msgs has to be built, which takes a compiler."""
    if type_name == messages.TF and not has_tf(rclpy):
        pytest.skip("tf2_msgs is not built: tests/peers/setup builds it where cmake and a compiler are")
    return type_name


def has_tf(rclpy: Peer) -> bool:
    try:
        rclpy.query(do="hash", type=messages.TF)
    except AssertionError:
        return False
    return True


def rig(model: str) -> Rig:
    values = {"alpha": 0.5, "beta": 1.1, "xi": 0.1}
    given = {name: values.get(name, 1e-3) for name in MODELS[model].parameters}
    size = {"width": 640, "height": 480, "fx": 500.0, "fy": 501.0, "cx": 319.5, "cy": 239.5}
    return Rig("front", build(model, **{**given, **size}), "camera", "lidar", T_CAMERA_LIDAR, np.eye(4))


def written() -> list[tuple[str, bytes]]:
    """One or more of each type that coec writes."""
    return [
        *(message_encoding.encode_image(CameraFrame(STAMP_NS, "camera", image)) for image in IMAGES),
        (messages.COMPRESSED_IMAGE, message_encoding.encode_depth(STAMP_NS, "camera", IMAGES[0])),
        (messages.POINT_CLOUD, message_encoding.encode_cloud(SWEEP)),
        *(message_encoding.encode_motion(motion) for motion in (MOTION, replace(MOTION, linear_mps=None))),
        *((messages.CAMERA_INFO, message_encoding.encode_camera_info(rig(model), STAMP_NS)) for model in MODELS),
        (messages.TF, message_encoding.encode_tf_static(rig("pinhole"), T_CAMERA_LIDAR, STAMP_NS)),
        (messages.DIAGNOSTICS, message_encoding.encode_diagnostics(STAMP_NS, STATUSES)),
        (messages.DIAGNOSTICS, message_encoding.encode_diagnostics(STAMP_NS, [])),
    ]


def names(value: object) -> str | None:
    """Of a test: the type, not the bytes."""
    return value if isinstance(value, str) else ""


def plain(value: Any) -> Any:
    """A message of rosbags, or a frame, as the values that the other side tells; constants are in capitals."""
    if is_dataclass(value):
        names = [field.name for field in fields(value) if field.name[0] != "_" and not field.name.isupper()]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(item) for item in value]
    return value


def reported_by(rclpy: Peer, type_name: str, payload: bytes) -> Any:
    fields_of = rclpy.query(do="read", type=known(rclpy, type_name), cdr=payload.hex())["fields"]
    return levelled(fields_of)


def levelled(reported: Any) -> Any:
    """`byte` is bytes of length one in rclpy, and a number in rosbags."""
    if isinstance(reported, Mapping):
        return {name: item[0] if name == "level" else levelled(item) for name, item in reported.items()}
    return [levelled(item) for item in reported] if isinstance(reported, list) else reported


@pytest.mark.parametrize(("type_name", "payload"), written(), ids=names)
def test_what_is_written_is_read_by_rclpy(rclpy: Peer, type_name: str, payload: bytes) -> None:
    assert reported_by(rclpy, type_name, payload) == plain(STORE.deserialize_cdr(payload, type_name))


def test_values_arrive_where_a_node_searches_them(rclpy: Peer) -> None:
    cloud = reported_by(rclpy, messages.POINT_CLOUD, message_encoding.encode_cloud(SWEEP))
    x = next(field for field in cloud["fields"] if field["name"] == "x")
    assert (x["offset"], x["datatype"], x["count"]) == (0, 7, 1)
    assert bytes(cloud["data"][:12]) == SWEEP.xyz_m[0].tobytes()
    odometry = reported_by(rclpy, messages.ODOMETRY, message_encoding.encode_motion(MOTION)[1])
    assert odometry["twist"]["twist"]["linear"] == {"x": 12.5, "y": -1e-9, "z": 0.0}


@pytest.mark.parametrize(("type_name", "payload"), written(), ids=names)
def test_what_rclpy_writes_coec_reads(rclpy: Peer, type_name: str, payload: bytes) -> None:
    fields_of = rclpy.query(do="read", type=known(rclpy, type_name), cdr=payload.hex())["fields"]
    theirs = bytes.fromhex(rclpy.query(do="write", type=type_name, fields=fields_of)["cdr"])
    assert plain(STORE.deserialize_cdr(theirs, type_name)) == plain(STORE.deserialize_cdr(payload, type_name))
    if type_name in FRAMES:
        assert plain(message_decoding.decode(type_name, theirs, LIMITS)) == plain(
            message_decoding.decode(type_name, payload, LIMITS)
        )


OF_ROS = {name for name in vars(messages).values() if isinstance(name, str) and name in STORE.fielddefs}
"""Types beside ROS are left out: there are no wheels of their packages."""


@pytest.mark.parametrize("type_name", sorted(OF_ROS))
def test_types_have_the_hash_of_ros(rclpy: Peer, type_name: str) -> None:
    assert rclpy.query(do="hash", type=known(rclpy, type_name))["hash"] == messages.type_hash(type_name)


def test_every_message_of_a_window_is_read_by_rclpy(rclpy: Peer, tmp_path: Path) -> None:
    path = tmp_path / "front-1.mcap"
    writer = WindowWriter(path, rig("double_sphere"), T_CAMERA_LIDAR, "front-1", CalibrationConfig(), {})
    for number, image in enumerate(IMAGES):
        stamp_ns = STAMP_NS + number * 10**9
        camera = CameraFrame(stamp_ns, "camera", image, depth=IMAGES[0])
        writer.add(FramePair(camera, replace(SWEEP, stamp_ns=stamp_ns), replace(MOTION, stamp_ns=stamp_ns)))
    writer.finish()
    read = set()
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema is None or schema.encoding != "ros2msg" or (schema.name == messages.TF and not has_tf(rclpy)):
                continue
            theirs = reported_by(rclpy, schema.name, message.data)
            assert theirs == plain(STORE.deserialize_cdr(message.data, schema.name)), channel.topic
            read.add(schema.name)
    assert read >= FRAMES - {messages.IMU} | {messages.CAMERA_INFO}
