"""ROS 2 messages in CDR: what a recorder, a player and the service itself give."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.adapters.images.raw import BYTES_PER_PIXEL
from coec.adapters.ros import point_cloud2
from coec.adapters.ros.messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    DIAGNOSTICS,
    IMAGE,
    IMU,
    ODOMETRY,
    POINT_CLOUD,
    TF,
    serialized,
)
from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, LidarFrame, Matrix4, Rig
from coec.geometry.cameras import intrinsics_of, name_of
from coec.geometry.se3 import quaternion_xyzw_from_rotation

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

_UNKNOWN_POSE_M2 = 1e9
"""Variance written for the pose of a recorded odometry, of which only the twist is known: (30 km)²."""


def encode_image(frame: CameraFrame) -> tuple[str, bytes]:
    """Type name and message: `CompressedImage` for JPEG and PNG, `Image` for raw pixels."""
    image = frame.image
    header = _header(frame.stamp_ns, frame.frame_id)
    data = np.frombuffer(image.data, np.uint8)
    if image.format not in BYTES_PER_PIXEL:
        compressed = ros.sensor_msgs__msg__CompressedImage(header=header, format=image.format.value, data=data)
        return COMPRESSED_IMAGE, serialized(compressed, COMPRESSED_IMAGE)
    raw = ros.sensor_msgs__msg__Image(
        header=header,
        height=image.height,
        width=image.width,
        encoding=image.format.value,
        is_bigendian=0,
        step=image.width * BYTES_PER_PIXEL[image.format],
        data=data,
    )
    return IMAGE, serialized(raw, IMAGE)


def encode_depth(stamp_ns: int, frame_id: str, depth: EncodedImage) -> bytes:
    """`CompressedImage` of a precomputed depth map (PNG); `decode` gives it back as the image of a frame."""
    message = ros.sensor_msgs__msg__CompressedImage(
        header=_header(stamp_ns, frame_id), format=DEPTH_FORMAT, data=np.frombuffer(depth.data, np.uint8)
    )
    return serialized(message, COMPRESSED_IMAGE)


def encode_cloud(frame: LidarFrame) -> bytes:
    """`PointCloud2` that decodes to an equal sweep."""
    return serialized(point_cloud2.message_of(frame), POINT_CLOUD)


def encode_motion(motion: EgoMotion) -> tuple[str, bytes]:
    """Type name and message: `Odometry`, or `Imu` where the linear velocity is not known. Either decodes to an equal
    motion."""
    if motion.linear_mps is None:
        return IMU, _encode_imu(motion)
    return ODOMETRY, _encode_odometry(motion, motion.linear_mps)


def _encode_imu(motion: EgoMotion) -> bytes:
    """What is not known says so by its covariance, which begins with -1 (sensor_msgs/Imu)."""
    unknown = np.array([-1.0, *[0.0] * 8])
    message = ros.sensor_msgs__msg__Imu(
        header=_header(motion.stamp_ns, motion.frame_id),
        orientation=ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0),
        orientation_covariance=unknown,
        angular_velocity=ros.geometry_msgs__msg__Vector3(*motion.angular_radps),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=ros.geometry_msgs__msg__Vector3(0.0, 0.0, 0.0),
        linear_acceleration_covariance=unknown,
    )
    return serialized(message, IMU)


def _encode_odometry(motion: EgoMotion, linear_mps: tuple[float, float, float]) -> bytes:
    """The twist is expressed in the child frame; the pose is unknown and says so by its covariance."""
    unknown = np.diag(np.full(6, _UNKNOWN_POSE_M2)).reshape(-1)
    message = ros.nav_msgs__msg__Odometry(
        header=_header(motion.stamp_ns, "odom"),
        child_frame_id=motion.frame_id,
        pose=ros.geometry_msgs__msg__PoseWithCovariance(
            pose=ros.geometry_msgs__msg__Pose(
                position=ros.geometry_msgs__msg__Point(0.0, 0.0, 0.0),
                orientation=ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0),
            ),
            covariance=unknown,
        ),
        twist=ros.geometry_msgs__msg__TwistWithCovariance(
            twist=ros.geometry_msgs__msg__Twist(
                linear=ros.geometry_msgs__msg__Vector3(*linear_mps),
                angular=ros.geometry_msgs__msg__Vector3(*motion.angular_radps),
            ),
            covariance=np.zeros(36),
        ),
    )
    return serialized(message, ODOMETRY)


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
    return serialized(message, CAMERA_INFO)


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
    return serialized(ros.tf2_msgs__msg__TFMessage(transforms=[transform]), TF)


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
    return serialized(message, DIAGNOSTICS)


def _header(stamp_ns: int, frame_id: str) -> ros.std_msgs__msg__Header:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(seconds, nanoseconds), frame_id)
