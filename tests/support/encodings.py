"""Messages of ROS 2 in other encodings: those of ROS 1, by `rosbags`; Foxglove's schemas, by Foxglove's SDK and as
JSON; and clouds in the forms of point_cloud_transport, by the libraries that pack them."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zstandard
from numpy.typing import NDArray

from support.recordings import STORE
from support.ros import CODES, Packer


def of_ros_1(message: Any) -> tuple[str, bytes]:
    """Type, and data in the encoding of ROS 1."""
    name = message.__msgtype__
    return name, bytes(STORE.cdr_to_ros1(STORE.serialize_cdr(message, name), name))


FOXGLOVE_TYPES = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""The number of a type in `foxglove.PackedElementField`, by that in `sensor_msgs/PointField`."""


def foxglove_values(message: Any) -> tuple[str, dict[str, Any]]:
    """Schema and fields of a message of the drive."""
    header = getattr(message, "header", None)
    head = {}
    if header is not None:
        stamp = {"sec": header.stamp.sec, "nsec": header.stamp.nanosec}
        head = {"timestamp": stamp, "frame_id": header.frame_id}
    match message.__msgtype__:
        case "sensor_msgs/msg/CompressedImage":
            return "CompressedImage", {**head, "data": message.data.tobytes(), "format": "jpeg"}
        case "sensor_msgs/msg/PointCloud2":
            fields = [
                {"name": field.name, "offset": field.offset, "type": FOXGLOVE_TYPES[field.datatype]}
                for field in message.fields
            ]
            cloud = {"point_stride": message.point_step, "fields": fields, "data": message.data.tobytes()}
            return "PointCloud", {**head, **cloud}
        case "sensor_msgs/msg/CameraInfo":
            matrices = {name.upper(): getattr(message, name).tolist() for name in "dkrp"}
            size = {"width": message.width, "height": message.height}
            return "CameraCalibration", {**head, **size, **matrices, "distortion_model": message.distortion_model}
        case "tf2_msgs/msg/TFMessage":
            return "FrameTransforms", {"transforms": [foxglove_transform(one) for one in message.transforms]}
        case "nav_msgs/msg/Odometry":
            twist, pose = message.twist.twist, message.pose.pose
            place, turn = vector(pose.position), {axis: getattr(pose.orientation, axis) for axis in "xyzw"}
            velocities = {"linear_velocity": vector(twist.linear), "angular_velocity": vector(twist.angular)}
            motion = {"body_frame_id": message.child_frame_id, "pose": {"position": place, "orientation": turn}}
            return "Odometry", {**head, **motion, **velocities}
    raise AssertionError


def vector(message: Any) -> dict[str, float]:
    return {axis: getattr(message, axis) for axis in "xyz"}


def foxglove_transform(stamped: Any) -> dict[str, Any]:
    turn = stamped.transform.rotation
    return {
        "parent_frame_id": stamped.header.frame_id,
        "child_frame_id": stamped.child_frame_id,
        "translation": vector(stamped.transform.translation),
        "rotation": {axis: getattr(turn, axis) for axis in "xyzw"},
    }


def protobuf_of(schema: str, values: dict[str, Any]) -> bytes:
    """The message as Foxglove's SDK encodes it."""
    sdk = pytest.importorskip("foxglove.messages")

    def built(name: str, fields: dict[str, Any]) -> Any:
        made = dict(fields)
        if "timestamp" in made:
            made["timestamp"] = sdk.Timestamp(**made["timestamp"])
        if "translation" in made:
            made["translation"] = sdk.Vector3(**made["translation"])
            made["rotation"] = sdk.Quaternion(**made["rotation"])
        for key in {"linear_velocity", "angular_velocity", "position"} & made.keys():
            made[key] = sdk.Vector3(**made[key])
        if "orientation" in made:
            made["orientation"] = sdk.Quaternion(**made["orientation"])
        if "pose" in made:
            made["pose"] = built("Pose", made["pose"])
        if "transforms" in made:
            made["transforms"] = [built("FrameTransform", one) for one in made["transforms"]]
        if "fields" in made:
            names = ["", "Uint8", "Int8", "Uint16", "Int16", "Uint32", "Int32", "Float32", "Float64"]
            kinds = [getattr(sdk.PackedElementFieldNumericType, name) for name in names[1:]]
            made["fields"] = [
                sdk.PackedElementField(name=f["name"], offset=f["offset"], type=kinds[f["type"] - 1])
                for f in made["fields"]
            ]
        return getattr(sdk, name)(**made)

    return bytes(built(schema, values).encode())


def json_of(schema: str, values: dict[str, Any]) -> bytes:
    """The message as JSON."""
    del schema
    text = {**values, "data": base64.b64encode(values["data"]).decode()} if "data" in values else values
    return json.dumps(text).encode()


def of_zlib(rows: NDArray[Any]) -> bytes:
    """The points as point_cloud_transport packs them with `zlib`."""
    return zlib.compress(rows.tobytes())


def of_zstd(rows: NDArray[Any]) -> bytes:
    """The same with `zstd`."""
    return zstandard.compress(rows.tobytes())


def of_cloudini(rows: NDArray[Any], resolution_m: float | None = None, **options: Any) -> bytes:
    """The same with `cloudini`, lossless or in steps of a resolution."""
    pureini = pytest.importorskip("pureini", reason="needs the extra cloudini")
    assert rows.dtype.fields is not None
    fields = [
        pureini.PointField(name, place[1], pureini.FieldType(CODES[place[0].str.replace("|", "")]), resolution_m)
        for name, place in rows.dtype.fields.items()
    ]
    lossless, lossy = pureini.EncodingOptions.LOSSLESS, pureini.EncodingOptions.LOSSY
    info = pureini.EncodingInfo(
        fields,
        width=len(rows),
        point_step=rows.itemsize,
        encoding_opt=lossless if resolution_m is None else lossy,
        compression_opt=pureini.CompressionOption.ZSTD,
        **options,
    )
    return bytes(pureini.PointcloudEncoder(info).encode(rows.tobytes()))


def of_draco(rows: NDArray[Any], *, kd_tree: bool = False, bits: int = 20) -> bytes:
    """The same with `draco`: one attribute of three components for the position; the others in the order of the fields,
    with their names."""
    draco = pytest.importorskip("DracoPy", reason="needs the extra draco")
    assert rows.dtype.names is not None
    others = {name: rows[name][:, None] for name in rows.dtype.names if name not in "xyz"}
    whole = {name: values.astype(np.uint32) if values.dtype.kind in "iu" else values for name, values in others.items()}
    return bytes(
        draco.encode(
            np.stack([rows[axis] for axis in "xyz"], axis=1),
            quantization_bits=bits,
            preserve_order=not kd_tree,
            create_metadata=True,
            generic_attributes=whole,
        )
    )


def packed_message(head: Packer, form: str, packed: bytes, width: int, step: int, fields: Any) -> bytes:
    """`point_cloud_interfaces/CompressedPointCloud2` in CDR; `fields` are name, offset and type of each."""
    packer = head.put("I", 1, width, len(fields))
    for name, offset, datatype in fields:
        packer.text(name).put("I", offset).put("B", datatype).put("I", 1)
    packer.put("?", False).put("I", step, width * step % 2**32).octets(packed).put("?", True)
    return packer.text(form).done()


def packed_cloud_of(cloud: Any, form: str, pack: Callable[[NDArray[Any]], bytes]) -> bytes:
    """The cloud of a `PointCloud2` in such a message."""
    forms = {number: form for form, number in CODES.items()}
    columns = {
        "names": [field.name for field in cloud.fields],
        "formats": [forms[field.datatype] for field in cloud.fields],
        "offsets": [field.offset for field in cloud.fields],
        "itemsize": cloud.point_step,
    }
    rows = np.frombuffer(cloud.data.tobytes(), np.dtype(columns))  # type: ignore[call-overload]
    head = Packer().header(cloud.header.frame_id, cloud.header.stamp.sec, cloud.header.stamp.nanosec)
    fields = [(field.name, field.offset, field.datatype) for field in cloud.fields]
    return packed_message(head, form, pack(rows), len(rows), cloud.point_step, fields)
