"""Encodes ROS 2 messages in CDR, for the recorder, the player and the service: images, clouds, motion, camera info,
transforms, and `/diagnostics` with the only mapping from health, or from a result, to ROS levels and values.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
from rosbags.typesys.stores import ros2_humble as ros

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame, Matrix4, Rig
from coec.errors import CoecError
from coec.geometry.cameras import MODELS, Camera, intrinsics_of, name_of, unproject_point
from coec.geometry.cameras.base import CommonIntrinsics
from coec.geometry.cameras.kannala_brandt import fit_kannala_brandt
from coec.geometry.se3 import quaternion_xyzw_from_rotation
from coec.io.frame_validation import BYTES_PER_PIXEL
from coec.io.ros import messages, point_clouds
from coec.schemas import replies
from coec.schemas.keys import sensor_status_name, status_name
from coec.schemas.replies import AXES, ROS_LEVELS, UNITS, CalibrationResult, HealthReply, MetricReply
from coec.schemas.rig_state import SensorReply, SensorState

ServicePhase = Literal["starting", "running", "stopping", "failing"]
"""State of the whole service, as in `status`."""


MAX_MESSAGE: Final = 500
"""Most characters of the sentence, which panels show in one line; the values hold every reason in full."""


class DiagnosticLevel(IntEnum):
    """`diagnostic_msgs/DiagnosticStatus.level`."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """`diagnostic_msgs/DiagnosticStatus`."""

    level: DiagnosticLevel
    name: str
    message: str
    hardware_id: str
    values: Mapping[str, str]


def hardware_id(vehicle: str, pair: str, serial: str | None) -> str:
    """The camera's serial number, or vehicle and pair if there is none."""
    return serial or f"{vehicle}/{pair}"


def level_of(health: HealthReply, service: ServicePhase) -> DiagnosticLevel:
    """The level of the state (`replies.ROS_LEVELS`), with exceptions: STALE if the reply is no longer renewed or the
    service stops, and at least ERROR if the service fails."""
    level = DiagnosticLevel(ROS_LEVELS[health.state])
    if service == "stopping" or any(reason.code == replies.SERVICE_STUCK for reason in health.reasons):
        return DiagnosticLevel.STALE
    return max(level, DiagnosticLevel.ERROR) if service == "failing" else level


def status_of_health(
    health: HealthReply, service: ServicePhase, serial: str | None, more: Mapping[str, str]
) -> DiagnosticStatus:
    """The status of a pair now. `more` holds values that health does not have."""
    return DiagnosticStatus(
        level_of(health, service),
        status_name(health.pair),
        _status_message(health, service),
        hardware_id(health.vehicle, health.pair, serial),
        {**_health_values(health), "service": service, **more},
    )


SENSOR_LEVELS: Final[Mapping[SensorState, DiagnosticLevel]] = {
    "calibrated": DiagnosticLevel.OK,
    "undecided": DiagnosticLevel.WARN,
    "camera_moved": DiagnosticLevel.ERROR,
    "lidar_moved": DiagnosticLevel.ERROR,
    "unknown": DiagnosticLevel.STALE,
}


def status_of_sensor(sensor: SensorReply, vehicle: str, service: ServicePhase) -> DiagnosticStatus:
    """The status of a sensor of a rig now; STALE if the service stops."""
    level = DiagnosticLevel.STALE if service == "stopping" else SENSOR_LEVELS[sensor.state]
    text = ": ".join([sensor.state, *(reason.text for reason in sensor.reasons[:1])])
    values = {"state": sensor.state, "kind": sensor.kind, "pairs": ", ".join(sensor.pairs), "service": service}
    values |= {f"reason {reason.code}": reason.text for reason in sensor.reasons}
    if sensor.probability is not None:
        values["probability of a move"] = f"{sensor.probability:.4g}"
    if sensor.since_ns is not None:
        values["since_ns"] = str(sensor.since_ns)
    if sensor.moved is not None:
        axes = zip(AXES, sensor.moved.by, sensor.moved.sigma, UNITS, strict=True)
        values["moved"] = ", ".join(f"{axis} {by:.3g} ± {sigma:.2g} {unit}" for axis, by, sigma, unit in axes)
    name = sensor_status_name(sensor.name)
    return DiagnosticStatus(level, name, text[:MAX_MESSAGE], hardware_id(vehicle, sensor.name, None), values)


def status_of_result(result: CalibrationResult) -> DiagnosticStatus:
    """The status in a window's file: an accepted result has the level of a healthy pair, a failed one that of a
    degraded pair."""
    reasons = result.verdict.reasons
    return DiagnosticStatus(
        DiagnosticLevel(ROS_LEVELS["degraded" if reasons else "healthy"]),
        status_name(result.pair),
        "; ".join(reason.text for reason in reasons) or "calibration accepted",
        hardware_id(result.vehicle, result.pair, None),
        {name: _figure_text(metric) for name, metric in result.metrics.items()},
    )


def _status_message(health: HealthReply, service: ServicePhase) -> str:
    """The state and its reasons in one line."""
    state = health.state if service in ("starting", "running") else f"{health.state}, service {service}"
    text = ": ".join([state, *(["; ".join(reason.text for reason in health.reasons)] if health.reasons else [])])
    return text if len(text) <= MAX_MESSAGE else f"{text[: MAX_MESSAGE - 1]}…"


def _health_values(health: HealthReply) -> dict[str, str]:
    """Everything that health holds, one value each; unknown values are left out."""
    values = {"state": health.state, "since_ns": str(health.since_ns)}
    values |= {f"reason {reason.code}": reason.text for reason in health.reasons}
    values |= {f"need {number}": need for number, need in enumerate(health.needs, 1)}
    if health.age_s is not None:
        values["age_s"] = f"{health.age_s:.1f}"
    if health.evaluated_ns is not None:
        values["evaluated_ns"] = str(health.evaluated_ns)
    values |= {name: _figure_text(metric) for name, metric in health.metrics.items()}
    for name in AXES:
        axis: replies.AxisReply = getattr(health.axes, name)
        sigma = "unknown" if axis.sigma is None else f"{axis.sigma:.4g} {axis.unit}"
        values[f"axis {name}"] = f"{axis.status}, correction {axis.correction:.4g} {axis.unit}, sigma {sigma}"
    drifts = {"drift from commissioned": health.drift, "drift of the latest result": health.result_drift}
    for name, drift in drifts.items():
        if drift is not None:
            axes = zip(AXES, drift, UNITS, strict=True)
            values[name] = ", ".join(f"{axis} {value:.4g} {unit}" for axis, value, unit in axes if value is not None)
    quality = health.data_quality
    figures = {"pair_rate_hz": quality.pair_rate_hz, "sync_error_s": quality.sync_error_s}
    values |= {name: f"{value:.4g}" for name, value in figures.items() if value is not None}
    values["frozen_image"] = str(quality.frozen_image).lower()
    for place, causes in quality.drops.items():
        values |= {f"lost {place} {cause}": str(count) for cause, count in causes.items()}
    return values


def _figure_text(metric: MetricReply) -> str:
    value = "unknown" if metric.value is None else f"{metric.value:.6g}"
    if metric.limit is None:
        return value
    bound = "at least" if metric.at_least else "at most"
    return f"{value} ({bound} {metric.limit:.6g}, {'passed' if metric.passed else 'failed'})"


DEPTH_FORMAT: Final = "16UC1; png"
"""`CompressedImage.format` of a recorded depth map."""

_ROS_DISTORTION: Final[Mapping[str, str]] = MappingProxyType(
    {
        "pinhole": "plumb_bob",
        "radtan": "plumb_bob",
        "rational": "rational_polynomial",
        "kannala_brandt": "equidistant",
    }
)

DISTORTION: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = MappingProxyType(
    {
        name: (
            _ROS_DISTORTION.get(name, name),
            tuple(one for one in model.parameters if one not in CommonIntrinsics._fields),
        )
        for name, model in MODELS.items()
    }
)
"""`CameraInfo.distortion_model` and the order of `d`, by camera model. `plumb_bob`, `rational_polynomial` and
`equidistant` are from sensor_msgs/distortion_models.hpp. ROS has no names for the others, so that they have the names
of `dataset.yaml`."""

_UNKNOWN_POSE_M2 = 1e9
"""Variance of the pose in a recorded odometry, whose pose is not known: (30 km)²."""


def encode_image(frame: CameraFrame) -> tuple[str, bytes]:
    """Type name and message: `CompressedImage` for JPEG and PNG, `Image` for raw pixels."""
    image = frame.image
    if image.format not in BYTES_PER_PIXEL:
        return messages.COMPRESSED_IMAGE, _encode_compressed(
            frame.stamp_ns, frame.frame_id, image.format.value, image.data
        )
    raw = ros.sensor_msgs__msg__Image(
        header=_header(frame.stamp_ns, frame.frame_id),
        height=image.height,
        width=image.width,
        encoding=image.format.value,
        is_bigendian=0,
        step=image.width * BYTES_PER_PIXEL[image.format],
        data=np.frombuffer(image.data, np.uint8),
    )
    return messages.IMAGE, messages.serialized(raw, messages.IMAGE)


def encode_depth(stamp_ns: int, frame_id: str, depth: EncodedImage) -> bytes:
    """`CompressedImage` of a precomputed depth map (PNG); `decode` returns it as the image of a frame."""
    return _encode_compressed(stamp_ns, frame_id, DEPTH_FORMAT, depth.data)


def encode_jpeg(stamp_ns: int, frame_id: str, jpeg: bytes) -> bytes:
    """`CompressedImage` of a drawn picture."""
    return _encode_compressed(stamp_ns, frame_id, ImageFormat.JPEG.value, jpeg)


def _encode_compressed(stamp_ns: int, frame_id: str, form: str, data: bytes) -> bytes:
    message = ros.sensor_msgs__msg__CompressedImage(
        header=_header(stamp_ns, frame_id), format=form, data=np.frombuffer(data, np.uint8)
    )
    return messages.serialized(message, messages.COMPRESSED_IMAGE)


def encode_cloud(frame: LidarFrame) -> bytes:
    """`PointCloud2` that decodes to an equal sweep."""
    return messages.serialized(point_clouds.message_of(frame), messages.POINT_CLOUD)


def encode_motion(motion: EgoMotion) -> tuple[str, bytes]:
    """Type name and message: `Odometry`, or `Imu` if the linear velocity is not known. Either decodes to an equal
    motion."""
    if motion.linear_mps is None:
        return messages.IMU, _encode_imu(motion)
    return messages.ODOMETRY, _encode_odometry(motion, motion.linear_mps)


def _encode_imu(motion: EgoMotion) -> bytes:
    """The covariance of an unknown value begins with -1 (sensor_msgs/Imu)."""
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
    return messages.serialized(message, messages.IMU)


def _encode_odometry(motion: EgoMotion, linear_mps: tuple[float, float, float]) -> bytes:
    """The twist is expressed in the child frame; the pose is unknown, which its covariance shows."""
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
    return messages.serialized(message, messages.ODOMETRY)


MAX_RESIDUAL_PX: Final = 0.5
"""Largest error, px, of an `equidistant` model in place of one that ROS does not have; a larger one would put points on
the next pixel."""

ROS_MODELS: Final = frozenset({"plumb_bob", "rational_polynomial", "equidistant"})
"""Models that ROS's own programs know (sensor_msgs/distortion_models.hpp)."""


class UnsupportedCameraError(CoecError):
    """ROS has no camera model that comes near the camera's."""

    reply_code = "camera_not_sayable"


def ros_camera(camera: Camera) -> tuple[Camera, float]:
    """The camera in a model that ROS's own programs know, and its largest error in pixels.

    Raises:
        UnsupportedCameraError: no model is within `MAX_RESIDUAL_PX`.
    """
    if DISTORTION[name_of(camera)][0] in ROS_MODELS:
        return camera, 0.0
    try:
        fit = fit_kannala_brandt(camera, partial(unproject_point, camera))
    except ValueError as error:
        raise UnsupportedCameraError(f"ROS has no model {name_of(camera)}, and not as equidistant: {error}") from error
    if fit.residual_max_px > MAX_RESIDUAL_PX:
        raise UnsupportedCameraError(
            f"ROS has no model {name_of(camera)}, and as equidistant it would be {fit.residual_max_px:.2g} px off, "
            f"more than {MAX_RESIDUAL_PX:g} px: nodes need the intrinsics from where this configuration has them"
        )
    return fit.camera, fit.residual_max_px


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
    return messages.serialized(message, messages.CAMERA_INFO)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFrame:
    """A frame in its parent: `T_parent_child` (4, 4) maps coordinates of the child to those of the parent."""

    parent: str
    child: str
    T_parent_child: Matrix4


def encode_transforms(frames: Sequence[PlacedFrame], stamp_ns: int) -> bytes:
    """`TFMessage`. Like `PlacedFrame`, transforms of tf map coordinates of the child to those of the parent."""
    transforms = []
    for frame in frames:
        x, y, z, w = (float(v) for v in quaternion_xyzw_from_rotation(frame.T_parent_child[:3, :3]))
        transforms.append(
            ros.geometry_msgs__msg__TransformStamped(
                header=_header(stamp_ns, frame.parent),
                child_frame_id=frame.child,
                transform=ros.geometry_msgs__msg__Transform(
                    translation=ros.geometry_msgs__msg__Vector3(*(float(v) for v in frame.T_parent_child[:3, 3])),
                    rotation=ros.geometry_msgs__msg__Quaternion(x, y, z, w),
                ),
            )
        )
    return messages.serialized(ros.tf2_msgs__msg__TFMessage(transforms=transforms), messages.TF)


def encode_tf_static(rig: Rig, T_camera_lidar: Matrix4, stamp_ns: int) -> bytes:
    """`TFMessage` of a window: the LiDAR as a child of the camera, with `T_camera_lidar` (4, 4) unchanged."""
    return encode_transforms([PlacedFrame(rig.camera_frame, rig.lidar_frame, T_camera_lidar)], stamp_ns)


def encode_diagnostics(stamp_ns: int, statuses: Sequence[DiagnosticStatus]) -> bytes:
    """`DiagnosticArray`."""
    array = [
        ros.diagnostic_msgs__msg__DiagnosticStatus(
            level=int(status.level),
            name=status.name,
            message=status.message,
            hardware_id=status.hardware_id,
            values=[ros.diagnostic_msgs__msg__KeyValue(key, value) for key, value in status.values.items()],
        )
        for status in statuses
    ]
    message = ros.diagnostic_msgs__msg__DiagnosticArray(header=_header(stamp_ns, ""), status=array)
    return messages.serialized(message, messages.DIAGNOSTICS)


def _header(stamp_ns: int, frame_id: str) -> ros.std_msgs__msg__Header:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(seconds, nanoseconds), frame_id)
