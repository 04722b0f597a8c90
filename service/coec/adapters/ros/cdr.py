"""ROS 2 messages in CDR: frames in, and what the recorder writes. Message definitions are those of Humble.

Every length in a message is the sender's claim: what a decoder would build from it is bounded before it is
asked to.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeVar

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.frames.incoming import MAX_FRAME_ID, MAX_SPEED, Refusal, check_size
from coec.adapters.images.codec import CHANNELS, probe, raw_image
from coec.adapters.ros import point_cloud2
from coec.calibration.types import (
    CameraFrame,
    EgoMotion,
    EncodedImage,
    ImageFormat,
    LidarFrame,
    Matrix4,
    Rig,
)
from coec.config import LimitsConfig
from coec.errors import DecodeError
from coec.geometry.cameras import intrinsics_of, name_of
from coec.geometry.se3 import quaternion_xyzw_from_rotation

COMPRESSED_IMAGE: Final = "sensor_msgs/msg/CompressedImage"
IMAGE: Final = "sensor_msgs/msg/Image"
POINT_CLOUD: Final = "sensor_msgs/msg/PointCloud2"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
TWIST: Final = "geometry_msgs/msg/TwistStamped"
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
TF: Final = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"

DEPTH_FORMAT: Final = "16UC1; png"
"""`CompressedImage.format` of a recorded depth map."""

DISTORTION: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "pinhole": ("plumb_bob", ()),
    "radtan": ("plumb_bob", ("k1", "k2", "p1", "p2", "k3")),
    "kannala_brandt": ("equidistant", ("k1", "k2", "k3", "k4")),
    "mei": ("mei", ("xi", "k1", "k2", "p1", "p2")),
    "eucm": ("eucm", ("alpha", "beta")),
    "double_sphere": ("double_sphere", ("xi", "alpha")),
}
"""`CameraInfo.distortion_model` and the order of `d` by camera model. `plumb_bob` and `equidistant` are those
of sensor_msgs/distortion_models.hpp; ROS names no others that fit, so the rest go by the names of
`dataset.yaml`."""

_MAX_CLOUD_FIELDS = 64
"""Drivers write up to about a dozen. Each would become a Python object."""

_UNKNOWN_POSE_M2 = 1e9
"""Variance written for the pose of a recorded odometry, of which only the twist is known: (30 km)²."""

_STORE = get_typestore(Stores.ROS2_HUMBLE)

T = TypeVar("T")


# --- frames in ----------------------------------------------------------------------------------------------


def decode(type_name: str, payload: bytes, limits: LimitsConfig) -> CameraFrame | LidarFrame | EgoMotion:
    """The frame in a message of type `CompressedImage`, `Image`, `PointCloud2`, `Odometry` or `TwistStamped`.

    Stamp and frame id are those of the header; of an odometry the frame id is the child's, in which its twist
    is expressed. CDR has no sequence number.

    Raises:
        DecodeError: anything else, with a reason of `Refusal`.
    """
    if type_name not in _DECODERS:
        raise DecodeError(Refusal.MESSAGE_TYPE, f"messages of this type are not read; known: {', '.join(_DECODERS)}")
    check_size(payload, limits)
    return _DECODERS[type_name](payload, limits)


def _compressed_image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    message = _deserialize(ros.sensor_msgs__msg__CompressedImage, payload)
    # `format` is free text ("jpeg", "bgr8; jpeg compressed bgr8", ...): the first bytes of the data are what
    # counts.
    image = probe(message.data.tobytes(), limits)
    return CameraFrame(_stamp_ns(message.header), _frame_id(message.header.frame_id), image)


def _image(payload: bytes, limits: LimitsConfig) -> CameraFrame:
    message = _deserialize(ros.sensor_msgs__msg__Image, payload)
    try:
        form = ImageFormat(message.encoding)
        row = message.width * CHANNELS[form]
    except (ValueError, KeyError):
        raise DecodeError(Refusal.IMAGE_UNKNOWN_FORMAT, f"raw images must be one of {', '.join(CHANNELS)}") from None
    if message.step < row or message.data.size < (message.height - 1) * message.step + row:
        raise DecodeError(
            Refusal.IMAGE_SIZE_MISMATCH,
            f"{message.height} rows of {row} bytes, {message.step} apart, do not fit into {message.data.size}",
        )
    pixels = message.data
    if message.step != row:
        pixels = np.lib.stride_tricks.as_strided(pixels, (message.height, row), (message.step, 1), writeable=False)
    else:
        pixels = pixels[: message.height * row]
    image = raw_image(form, message.width, message.height, pixels.tobytes(), limits)
    return CameraFrame(_stamp_ns(message.header), _frame_id(message.header.frame_id), image)


def _point_cloud(payload: bytes, limits: LimitsConfig) -> LidarFrame:
    _check_cloud_fields(payload)
    message = _deserialize(ros.sensor_msgs__msg__PointCloud2, payload)
    _frame_id(message.header.frame_id)
    return point_cloud2.frame_of(message, _stamp_ns(message.header), limits)


def _odometry(payload: bytes, limits: LimitsConfig) -> EgoMotion:
    del limits
    message = _deserialize(ros.nav_msgs__msg__Odometry, payload)
    frame_id = message.child_frame_id or message.header.frame_id
    return _motion(_stamp_ns(message.header), frame_id, message.twist.twist)


def _twist(payload: bytes, limits: LimitsConfig) -> EgoMotion:
    del limits
    message = _deserialize(ros.geometry_msgs__msg__TwistStamped, payload)
    return _motion(_stamp_ns(message.header), message.header.frame_id, message.twist)


_DECODERS: Final[dict[str, Callable[[bytes, LimitsConfig], CameraFrame | LidarFrame | EgoMotion]]] = {
    COMPRESSED_IMAGE: _compressed_image,
    IMAGE: _image,
    POINT_CLOUD: _point_cloud,
    ODOMETRY: _odometry,
    TWIST: _twist,
}


def _deserialize(message_type: type[T], payload: bytes) -> T:
    try:
        message = _STORE.deserialize_cdr(payload, message_type.__msgtype__)  # type: ignore[attr-defined]
    except (SerdeError, ValueError, IndexError, struct.error) as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "not this message in CDR, or cut off") from error
    if not isinstance(message, message_type):
        raise TypeError(f"the type store made {type(message)} of {message_type}")
    return message


def _check_cloud_fields(payload: bytes) -> None:
    """Reads the number of fields ahead of the decoder: encapsulation, header, height, width, count."""
    order = "<" if payload[1:2] == b"\x01" else ">"
    try:
        (length,) = struct.unpack_from(f"{order}I", payload, 4 + 8)
        body = 8 + 4 + length
        (count,) = struct.unpack_from(f"{order}I", payload, 4 + body + (-body) % 4 + 8)
    except struct.error as error:
        raise DecodeError(Refusal.MESSAGE_MALFORMED, "the cloud ends within its header") from error
    if count > _MAX_CLOUD_FIELDS:
        raise DecodeError(Refusal.CLOUD_FIELDS, f"the cloud has more than {_MAX_CLOUD_FIELDS} fields")


def _stamp_ns(header: ros.std_msgs__msg__Header) -> int:
    seconds, nanoseconds = header.stamp.sec, header.stamp.nanosec
    if seconds < 0 or nanoseconds >= 10**9:
        raise DecodeError(Refusal.STAMP_INVALID, "the stamp is negative or has more than 10⁹ nanoseconds")
    return seconds * 10**9 + nanoseconds


def _frame_id(frame_id: str) -> str:
    if len(frame_id) > MAX_FRAME_ID:
        raise DecodeError(Refusal.FRAME_ID_INVALID, f"the frame id is longer than {MAX_FRAME_ID} characters")
    return frame_id


def _motion(stamp_ns: int, frame_id: str, twist: ros.geometry_msgs__msg__Twist) -> EgoMotion:
    linear, angular = twist.linear, twist.angular
    motion = EgoMotion(stamp_ns, _frame_id(frame_id), (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z))
    if not all(math.isfinite(v) and abs(v) <= MAX_SPEED for v in (*motion.linear_mps, *motion.angular_radps)):
        raise DecodeError(Refusal.MOTION_INVALID, "a velocity is not finite or beyond every vehicle")
    return motion


# --- messages out -------------------------------------------------------------------------------------------


def definition(type_name: str) -> str:
    """The message definition in ros2msg text, with those it refers to, as an MCAP schema wants it."""
    text, _ = _STORE.generate_msgdef(type_name, ros_version=2)
    return text


def encode_image(frame: CameraFrame) -> tuple[str, bytes]:
    """Type name and message: `CompressedImage` for JPEG and PNG, `Image` for raw pixels."""
    image = frame.image
    header = _header(frame.stamp_ns, frame.frame_id)
    data = np.frombuffer(image.data, np.uint8)
    if image.format not in CHANNELS:
        compressed = ros.sensor_msgs__msg__CompressedImage(header=header, format=image.format.value, data=data)
        return COMPRESSED_IMAGE, _serialize(compressed, COMPRESSED_IMAGE)
    raw = ros.sensor_msgs__msg__Image(
        header=header,
        height=image.height,
        width=image.width,
        encoding=image.format.value,
        is_bigendian=0,
        step=image.width * CHANNELS[image.format],
        data=data,
    )
    return IMAGE, _serialize(raw, IMAGE)


def encode_depth(stamp_ns: int, frame_id: str, depth: EncodedImage) -> bytes:
    """`CompressedImage` of a precomputed depth map (PNG); `decode` gives it back as the image of a frame."""
    message = ros.sensor_msgs__msg__CompressedImage(
        header=_header(stamp_ns, frame_id), format=DEPTH_FORMAT, data=np.frombuffer(depth.data, np.uint8)
    )
    return _serialize(message, COMPRESSED_IMAGE)


def encode_cloud(frame: LidarFrame) -> bytes:
    """`PointCloud2` that decodes to an equal sweep."""
    return _serialize(point_cloud2.message_of(frame), POINT_CLOUD)


def encode_odometry(motion: EgoMotion, child_frame: str) -> bytes:
    """`Odometry` whose twist is expressed in `child_frame`; its pose is unknown and says so by its
    covariance."""
    unknown = np.diag(np.full(6, _UNKNOWN_POSE_M2)).reshape(-1)
    message = ros.nav_msgs__msg__Odometry(
        header=_header(motion.stamp_ns, "odom"),
        child_frame_id=child_frame,
        pose=ros.geometry_msgs__msg__PoseWithCovariance(
            pose=ros.geometry_msgs__msg__Pose(
                position=ros.geometry_msgs__msg__Point(0.0, 0.0, 0.0),
                orientation=ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0),
            ),
            covariance=unknown,
        ),
        twist=ros.geometry_msgs__msg__TwistWithCovariance(
            twist=ros.geometry_msgs__msg__Twist(
                linear=ros.geometry_msgs__msg__Vector3(*motion.linear_mps),
                angular=ros.geometry_msgs__msg__Vector3(*motion.angular_radps),
            ),
            covariance=np.zeros(36),
        ),
    )
    return _serialize(message, ODOMETRY)


def encode_camera_info(rig: Rig, stamp_ns: int) -> bytes:
    """`CameraInfo` of the rig's camera; see `DISTORTION` for models that ROS does not know."""
    camera = rig.camera
    model, names = DISTORTION[name_of(camera)]
    intrinsics = intrinsics_of(camera)
    distortion = [float(intrinsics[name]) for name in names] or [0.0] * 5
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    message = ros.sensor_msgs__msg__CameraInfo(
        header=_header(stamp_ns, rig.camera_frame),
        height=camera.height,
        width=camera.width,
        distortion_model=model,
        d=np.array(distortion),
        k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        r=np.eye(3).reshape(-1),
        p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
        binning_x=0,
        binning_y=0,
        roi=ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, False),
    )
    return _serialize(message, CAMERA_INFO)


def encode_tf_static(rig: Rig, T_camera_lidar: Matrix4, stamp_ns: int) -> bytes:
    """`TFMessage` with the LiDAR as a child of the camera: tf maps coordinates of the child to those of the
    parent, so its transform is `T_camera_lidar` (4, 4) as it stands."""
    x, y, z, w = (float(v) for v in quaternion_xyzw_from_rotation(T_camera_lidar[:3, :3]))
    transform = ros.geometry_msgs__msg__TransformStamped(
        header=_header(stamp_ns, rig.camera_frame),
        child_frame_id=rig.lidar_frame,
        transform=ros.geometry_msgs__msg__Transform(
            translation=ros.geometry_msgs__msg__Vector3(*(float(v) for v in T_camera_lidar[:3, 3])),
            rotation=ros.geometry_msgs__msg__Quaternion(x, y, z, w),
        ),
    )
    return _serialize(ros.tf2_msgs__msg__TFMessage(transforms=[transform]), TF)


def encode_diagnostics(
    stamp_ns: int, name: str, level: int, text: str, values: Mapping[str, str], hardware_id: str
) -> bytes:
    """`DiagnosticArray` with one status; `level` 0 OK, 1 WARN, 2 ERROR, 3 STALE."""
    status = ros.diagnostic_msgs__msg__DiagnosticStatus(
        level=level,
        name=name,
        message=text,
        hardware_id=hardware_id,
        values=[ros.diagnostic_msgs__msg__KeyValue(key, value) for key, value in values.items()],
    )
    message = ros.diagnostic_msgs__msg__DiagnosticArray(header=_header(stamp_ns, ""), status=[status])
    return _serialize(message, DIAGNOSTICS)


def _header(stamp_ns: int, frame_id: str) -> ros.std_msgs__msg__Header:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(seconds, nanoseconds), frame_id)


def _serialize(message: Any, type_name: str) -> bytes:
    return bytes(_STORE.serialize_cdr(message, type_name, little_endian=True))
