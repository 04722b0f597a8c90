"""Files that nobody recorded: ROS 2 messages and bags, written by `mcap` and `rosbags`; clouds of NumPy and PCL and
ONNX networks, packed by hand after their specifications, so that no test needs a stored binary.

A network takes `image`, 1×3×height×width float32, and gives `depth`, 1×1×height×width: the first colour
channel, or what the further operator makes of it.
"""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_humble as ros

from coec.geometry import se3

STORE = get_typestore(Stores.ROS2_HUMBLE)
WIDTH, HEIGHT = 64, 48
FLOAT32, FLOAT64 = 7, 8  # sensor_msgs/PointField

R_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
T_BASE_LIDAR = se3.transform_from(se3.rotation_exp(np.array([0.0, 0.0, 0.3])), np.array([1.0, 0.0, 1.9]))
T_BASE_MOUNT = se3.transform_from(np.eye(3), np.array([1.5, 0.2, 1.4]))
T_MOUNT_OPTICAL = se3.transform_from(R_OPTICAL.T, np.array([0.01, 0.02, 0.03]))


def ros_header(stamp_ns: int, frame_id: str) -> Any:
    return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(*divmod(stamp_ns, 10**9)), frame_id)


def compressed_image_message(stamp_ns: int, frame_id: str = "optical") -> Any:
    data = np.frombuffer(cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), 99, np.uint8))[1].tobytes(), np.uint8)
    return ros.sensor_msgs__msg__CompressedImage(ros_header(stamp_ns, frame_id), "jpeg", data)


def raw_image_message(stamp_ns: int) -> Any:
    data = np.zeros(HEIGHT * WIDTH, np.uint8)
    return ros.sensor_msgs__msg__Image(ros_header(stamp_ns, "optical"), HEIGHT, WIDTH, "mono8", 0, WIDTH, data)


def cloud_message(stamp_ns: int, value: float = 1.0) -> Any:
    fields = [ros.sensor_msgs__msg__PointField(name, 4 * i, FLOAT32, 1) for i, name in enumerate("xyz")]
    data = np.frombuffer(np.full((4, 3), value, "<f4").tobytes(), np.uint8)
    return ros.sensor_msgs__msg__PointCloud2(ros_header(stamp_ns, "lidar"), 1, 4, fields, False, 12, 48, data, True)


def odometry_message(stamp_ns: int, forward_mps: float) -> Any:
    zero, unit = ros.geometry_msgs__msg__Point(0.0, 0.0, 0.0), ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0)
    twist = ros.geometry_msgs__msg__Twist(
        ros.geometry_msgs__msg__Vector3(forward_mps, 0.0, 0.0), ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.1)
    )
    return ros.nav_msgs__msg__Odometry(
        ros_header(stamp_ns, "odom"),
        "base",
        ros.geometry_msgs__msg__PoseWithCovariance(ros.geometry_msgs__msg__Pose(zero, unit), np.zeros(36)),
        ros.geometry_msgs__msg__TwistWithCovariance(twist, np.zeros(36)),
    )


def imu_message(stamp_ns: int, turn_radps: float) -> Any:
    zero = ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.0)
    turn = ros.geometry_msgs__msg__Vector3(0.0, 0.0, turn_radps)
    level = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0)
    return ros.sensor_msgs__msg__Imu(
        ros_header(stamp_ns, "base"), level, np.zeros(9), turn, np.zeros(9), zero, np.zeros(9)
    )


def timed_cloud_message(stamp_ns: int, name: str, times: list[float]) -> Any:
    """Points of x y z, and a time as float64."""
    fields = [ros.sensor_msgs__msg__PointField(axis, 4 * i, FLOAT32, 1) for i, axis in enumerate("xyz")]
    fields.append(ros.sensor_msgs__msg__PointField(name, 12, FLOAT64, 1))
    rows = np.ones(len(times), [("xyz", "<f4", 3), ("time", "<f8")])
    rows["time"] = times
    data, step = np.frombuffer(rows.tobytes(), np.uint8), rows.itemsize
    return ros.sensor_msgs__msg__PointCloud2(
        ros_header(stamp_ns, "lidar"), 1, len(times), fields, False, step, len(data), data, True
    )


def camera_info_message(model: str, d: list[float], frame_id: str = "optical", width: int = WIDTH) -> Any:
    return ros.sensor_msgs__msg__CameraInfo(
        ros_header(0, frame_id),
        HEIGHT,
        width,
        model,
        np.array(d, np.float64),
        np.array([50.0, 0, 31.5, 0, 51, 23.5, 0, 0, 1]),
        np.eye(3).reshape(-1),
        np.zeros(12),
        0,
        0,
        ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, False),
    )


def transform_message(parent: str, child: str, T: NDArray[np.float64], stamp_ns: int = 0) -> Any:
    return ros.geometry_msgs__msg__TransformStamped(
        ros_header(stamp_ns, parent),
        child,
        ros.geometry_msgs__msg__Transform(
            ros.geometry_msgs__msg__Vector3(*T[:3, 3].tolist()),
            ros.geometry_msgs__msg__Quaternion(*se3.quaternion_xyzw_from_rotation(T[:3, :3]).tolist()),
        ),
    )


TREE = [
    transform_message("base", "lidar", T_BASE_LIDAR),
    transform_message("base", "mount", T_BASE_MOUNT),
    transform_message("mount", "optical", T_MOUNT_OPTICAL),
]


@dataclass
class Bag:
    """Messages by topic, written in the order of their list."""

    messages: list[tuple[str, Any]] = field(default_factory=list)
    compression: CompressionType = CompressionType.NONE
    chunking: bool = True

    def write(self, path: Path) -> Path:
        with path.open("wb") as stream:
            writer = Writer(stream, chunk_size=2000, compression=self.compression, use_chunking=self.chunking)
            writer.start("ros2")
            channels: dict[tuple[str, str], int] = {}
            for time, (topic, message) in enumerate(self.messages):
                name = message.__msgtype__
                if (topic, name) not in channels:
                    definition, _ = STORE.generate_msgdef(name, ros_version=2)
                    schema = writer.register_schema(name, "ros2msg", definition.encode())
                    channels[topic, name] = writer.register_channel(topic, "cdr", schema)
                data = bytes(STORE.serialize_cdr(message, name))
                writer.add_message(channels[topic, name], time, data, time)
            writer.finish()  # type: ignore[no-untyped-call]
        return path


def converted(bag: Path, folder: Path, plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE) -> Path:
    """The messages of an MCAP file, byte for byte, as a folder that `rosbags` writes."""
    writer = Rosbag2(folder, version=9, storage_plugin=plugin)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with bag.open("rb") as stream, writer:
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            assert schema is not None
            if channel.topic not in connections:
                connections[channel.topic] = writer.add_connection(channel.topic, schema.name, typestore=STORE)
            writer.write(connections[channel.topic], message.log_time, message.data)
    return folder


def drive_messages(
    *, info: Any = None, tree: list[Any] | None = None, image: Any = compressed_image_message
) -> list[tuple[str, Any]]:
    """Camera at 10 Hz, LiDAR at 20 Hz and 4 ms later, odometry at 50 Hz; the recorder got them out of order."""
    second = 10**9
    images = [("/front/image", image(second + k * 100_000_000)) for k in range(4)]
    clouds = [("/points", cloud_message(second + 4_000_000 + k * 50_000_000, float(k + 1))) for k in range(8)]
    motions = [("/odom", odometry_message(second + k * 20_000_000, float(k))) for k in range(20)]
    head = [
        ("/tf_static", ros.tf2_msgs__msg__TFMessage(TREE if tree is None else tree)),
        ("/front/camera_info", info or camera_info_message("plumb_bob", [0.0] * 5)),
    ]
    return [*head, *motions[::-1], *clouds[::-1], *images]


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npy_with_header(header: str, body: bytes = b"") -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def npz(**members: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return stream.getvalue()


def pcd(fields: str, sizes: str, types: str, points: int, encoding: str, body: bytes = b"", counts: str = "") -> bytes:
    lines = ["VERSION 0.7", f"FIELDS {fields}", f"SIZE {sizes}", f"TYPE {types}", f"COUNT {counts}" if counts else "#"]
    lines += [f"WIDTH {points}", "HEIGHT 1", f"POINTS {points}", f"DATA {encoding}", ""]
    return "\n".join(lines).encode() + body


FLOAT, DOUBLE, INT64 = 1, 11, 7  # TensorProto.DataType
Dimension = int | str


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    parts.append(value)
    return bytes(parts)


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, value: bytes | str) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _value_info(name: str, element: int, shape: Sequence[Dimension]) -> bytes:
    dimensions = b"".join(_bytes(1, _number(1, each) if isinstance(each, int) else _bytes(2, each)) for each in shape)
    tensor = _number(1, element) + _bytes(2, dimensions)
    return _bytes(1, name) + _bytes(2, _bytes(1, tensor))


def _node(operator: str, inputs: Sequence[str], output: str, attributes: Sequence[bytes] = ()) -> bytes:
    names = b"".join(_bytes(1, each) for each in inputs)
    return names + _bytes(2, output) + _bytes(4, operator) + b"".join(_bytes(5, each) for each in attributes)


def _int_attribute(name: str, value: int) -> bytes:
    return _bytes(1, name) + _number(3, value) + _number(20, 2)


def first_channel_network(
    shape: Sequence[Dimension] = (1, 3, "h", "w"),
    *,
    then: str | None = None,
    element: int = FLOAT,
    input_name: str = "image",
    output_name: str = "depth",
    weights_file: str | None = None,
    second_output: bool = False,
) -> bytes:
    """The ONNX file of a network that gives the first colour channel of its input.

    Args:
        shape: of the input; a string is a free dimension of that name.
        then: operator of one input that the channel goes through, for example `Sqrt`.
        element: type of the input's elements.
        input_name, output_name: of the tensors.
        weights_file: where the one weight (an int64 zero) lies outside of this file; None keeps it inside.
        second_output: also give the whole input, as `copy`.
    """
    gathered = "channel" if then else output_name
    nodes = [_node("Gather", [input_name, "index"], gathered, [_int_attribute("axis", 1)])]
    if then:
        nodes.append(_node(then, [gathered], output_name))
    if second_output:
        nodes.append(_node("Identity", [input_name], "copy"))
    index = _number(1, 1) + _number(2, INT64) + _bytes(8, "index")
    if weights_file is None:
        index += _bytes(9, struct.pack("<q", 0))
    else:
        location = _bytes(1, "location") + _bytes(2, weights_file)
        length = _bytes(1, "length") + _bytes(2, "8")
        index += _bytes(13, location) + _bytes(13, length) + _number(14, 1)
    graph = b"".join(_bytes(1, node) for node in nodes) + _bytes(2, "tiny") + _bytes(5, index)
    graph += _bytes(11, _value_info(input_name, element, shape))
    graph += _bytes(12, _value_info(output_name, element, [shape[0], 1, *shape[2:]]))
    if second_output:
        graph += _bytes(12, _value_info("copy", element, shape))
    return _number(1, 8) + _bytes(7, graph) + _bytes(8, _bytes(1, "") + _number(2, 13))


MODEL_CARD = """
name: tiny
input: {name: image, size: {side: 32, multiple: 16, fit: short}, scale: 1.0}
output: {name: depth, kind: inverse_depth}
licence: CC0-1.0
source: tests
"""
"""A model card that fits `first_channel()`."""
