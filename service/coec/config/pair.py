"""One camera-LiDAR pair: its streams of images, clouds and ego-motion, the stages of its calibration, and the poses
between its sensors in the forms in which people write them: a matrix, or a position with a quaternion or angles,
and the direction in which they give the extrinsic.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeAlias, get_args

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, field_validator, model_validator

from coec.config import stages
from coec.config.model import IDENTITY, ConfigModel, FilePath, KeyExpression, Matrix4x4, Name, describe
from coec.geometry import CAMERA_MODELS

QUATERNION_TOLERANCE = 0.01
"""How far the length of a quaternion may be from 1: within this it is rounding, beyond it a mistyped number."""

FORMS = (
    "rows of 4x4 numbers, {xyz: [x, y, z], quaternion_xyzw: [x, y, z, w]}, {xyz: [x, y, z], rpy_deg: [roll, pitch, "
    "yaw]} or the same with rpy_rad"
)

FARTHEST_M = 50.0
"""Largest distance of two sensors of a vehicle; a longer translation is in other units."""

ROTATIONS = ("quaternion_xyzw", "quaternion", "rpy_deg", "rpy_rad")


class _WrittenPose(ConfigModel):
    """A position in metres with one of: a quaternion, its w last (`quaternion` is the same as `quaternion_xyzw`), or
    roll, pitch, yaw about the fixed axes x, y, z (URDF: R = Rz(yaw)·Ry(pitch)·Rx(roll))."""

    xyz: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float] | None = None
    quaternion: tuple[float, float, float, float] | None = None
    rpy_deg: tuple[float, float, float] | None = None
    rpy_rad: tuple[float, float, float] | None = None


def _rows_of_pose(value: Any) -> Any:
    """The rows of a pose that is written as a position and a rotation; any other value as it is."""
    if not isinstance(value, dict):
        return value
    from coec.config import poses

    try:
        written = _WrittenPose.model_validate(value)
    except ValidationError as error:
        raise ValueError(f"give {FORMS}: {describe(error)}") from None
    given = [name for name in ROTATIONS if getattr(written, name) is not None]
    if len(given) != 1:
        raise ValueError(f"give {FORMS}: {' and '.join(given) if given else 'no rotation'} is given")
    rotation = getattr(written, given[0])
    if given[0].startswith("rpy"):
        return poses.rows_of_angles(written.xyz, rotation, degrees=given[0] == "rpy_deg")
    length = sum(number * number for number in rotation) ** 0.5
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(f"{given[0]}: its length is {length:.3g}, not 1; its numbers are x, y, z, w")
    return poses.rows_of(written.xyz, rotation)


def _validated_rigid(rows: Matrix4x4) -> Matrix4x4:
    from coec.config import poses

    problem = poses.rigidity_problem(rows)
    if problem:
        raise ValueError(f"not a rigid transform: {problem}")
    return rows


WrittenPose = Annotated[Matrix4x4, BeforeValidator(_rows_of_pose)]
"""The rows of a pose in any form, not yet checked."""

Pose = Annotated[WrittenPose, AfterValidator(_validated_rigid)]
"""A rigid transform in any form."""


def with_direction(document: Any) -> Any:
    """A document that gives the extrinsic of a pair under one of three names, with `T_camera_lidar` in their place:
    `T_lidar_camera` is its inverse, and `T_camera_cloud` maps from the frame of the points, in which `T_cloud_lidar` is
    the pose of the LiDAR. Any other document is returned as it is.

    Raises:
        ValueError: there are several, or one is not a rigid transform of sensors on one vehicle.
    """
    if not isinstance(document, Mapping):
        return document
    names = [name for name in ("T_camera_lidar", "T_lidar_camera", "T_camera_cloud") if document.get(name) is not None]
    if len(names) > 1:
        raise ValueError(f"{' and '.join(names)} are given: give one of them")
    if not names:
        return document
    from coec.config import poses

    name = names[0]
    rows = _checked(name, document[name])
    rest = {key: value for key, value in document.items() if key != name}
    if name == "T_lidar_camera":
        rows = poses.inverse(rows)
    if name == "T_camera_cloud" and document.get("T_cloud_lidar") is not None:
        rows = poses.product(rows, _checked("T_cloud_lidar", document["T_cloud_lidar"]))
    return {**rest, "T_camera_lidar": rows}


class _OnePose(ConfigModel):
    pose: WrittenPose


def _checked(name: str, value: Any) -> Matrix4x4:
    from coec.config import poses

    try:
        rows = _OnePose(pose=value).pose
    except ValidationError as error:
        raise ValueError(describe(error).replace("pose", name, 1)) from None
    problem = poses.rigidity_problem(rows)
    if problem:
        raise ValueError(f"{name} is not a rigid transform: {problem}")
    length_m = sum(row[3] ** 2 for row in rows[:3]) ** 0.5
    if length_m > FARTHEST_M:
        raise ValueError(
            f"{name}: its translation is {length_m:.0f} m long; it is in metres: divide millimetres by 1000"
        )
    return rows


if TYPE_CHECKING:
    CameraModel: TypeAlias = str
else:
    CameraModel = Literal[CAMERA_MODELS]

# --- streams and pairs ------------------------------------------------------------------------------------------------

ROS_NAMES = {
    "plumb_bob": "radtan",
    "rational_polynomial": "rational",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
    "ds": "double_sphere",
    "cata": "mei",
}
"""Models of lenses by the names that ROS (sensor_msgs/distortion_models.hpp), OpenCV and Kalibr have for them."""


class CameraIntrinsics(ConfigModel):
    """Intrinsics of a camera; `model` determines which of the optional parameters are needed. The names are those of
    `dataset.yaml`."""

    model: CameraModel = Field(description="model of the lens")
    width: int = Field(gt=0, le=16384, description="image width, px")
    height: int = Field(gt=0, le=16384, description="image height, px")
    fx: float = Field(gt=0, description="focal length, px")
    fy: float = Field(gt=0, description="focal length, px")
    cx: float = Field(description="principal point, px; pixel centres at integers")
    cy: float = Field(description="principal point, px; pixel centres at integers")
    xi: float | None = Field(
        default=None, description="shift of the second sphere (double_sphere) or of the mirror (mei)"
    )
    alpha: float | None = Field(default=None, description="from pinhole to sphere (double_sphere, eucm), 0 to 1")
    beta: float | None = Field(default=None, description="form of the ellipsoid (eucm)")
    k1: float | None = Field(default=None, description="radial (radtan, rational, mei); of θ³ (kannala_brandt)")
    k2: float | None = Field(default=None, description="radial (radtan, rational, mei); of θ⁵ (kannala_brandt)")
    k3: float | None = Field(default=None, description="radial (radtan, rational); of θ⁷ (kannala_brandt)")
    k4: float | None = Field(default=None, description="radial, below the fraction (rational); of θ⁹ (kannala_brandt)")
    k5: float | None = Field(default=None, description="radial, below the fraction (rational)")
    k6: float | None = Field(default=None, description="radial, below the fraction (rational)")
    p1: float | None = Field(default=None, description="tangential (radtan, rational, mei)")
    p2: float | None = Field(default=None, description="tangential (radtan, rational, mei)")

    @field_validator("model", mode="before")
    @classmethod
    def _name_of_ros(cls, name: Any) -> Any:
        return ROS_NAMES.get(name, name) if isinstance(name, str) else name

    def parameters(self) -> dict[str, float]:
        """The intrinsics that were given, by name, without `model`."""
        return self.model_dump(exclude={"model"}, exclude_none=True)


class SweepConfig(ConfigModel):
    """Azimuth timing of a spinning LiDAR without per-point time: a point at azimuth a was measured
    `sign · wrap(a - stamp_azimuth_deg) / 360°` revolutions after the stamp."""

    period_s: float = Field(default=0.1, gt=0, le=10, description="one revolution, s")
    sign: Literal[-1, 1] = Field(default=-1, description="-1 clockwise seen from above, 1 counter-clockwise")
    stamp_azimuth_deg: float = Field(default=0.0, ge=-360, le=360, description="azimuth of the LiDAR at the stamp")


TimeUnit = Literal["s", "ms", "us", "ns"]
TimeBase = Literal["stamp", "clock", "begin", "end"]


class PointTimeConfig(ConfigModel):
    """How the points of a `PointCloud2` are timed, for clouds whose values do not show it."""

    field: str = Field(min_length=1, max_length=64, description="name of the field with the time")
    unit: TimeUnit = Field(description="unit of its values")
    base: TimeBase = Field(
        default="stamp",
        description="stamp: times since the cloud's stamp; clock: times on the clock of the stamp; begin, end: times "
        "on another clock, the stamp being that of the first or the last point",
    )


Encoding = Literal["msgpack", "cdr"]

TopicName = Annotated[str, Field(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$", max_length=247)]
"""A full ROS 2 topic name (rmw/validate_full_topic_name.h)."""

CameraMessage = Literal["sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"]
LidarMessage = Literal[
    "sensor_msgs/msg/PointCloud2",
    "livox_ros_driver2/msg/CustomMsg",
    "livox_ros_driver/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
]
PacketMessage = Literal[
    "velodyne_msgs/msg/VelodyneScan",
    "ouster_sensor_msgs/msg/PacketMsg",
    "ouster_msgs/msg/PacketMsg",
    "ouster_ros/msg/PacketMsg",
    "hesai_ros_driver/msg/UdpFrame",
    "pandar_msgs/msg/PandarScan",
    "nebula_msgs/msg/NebulaPackets",
    "rslidar_msg/msg/RslidarPacket",
]
EgoMessage = Literal[
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
    "sensor_msgs/msg/Imu",
    "tf2_msgs/msg/TFMessage",
]


class StreamConfig(ConfigModel):
    """Where the samples of a stream come from; a text in its place is short for `topic`."""

    key: KeyExpression | None = Field(default=None, description="Zenoh key of the frames")
    topic: TopicName | None = Field(
        default=None,
        description="ROS 2 topic, given instead of `key` unless `middleware` is native; its frames are CDR",
    )
    encoding: Encoding = Field(default="msgpack", description="assumed when a sample names no encoding")

    @property
    def place(self) -> str:
        """The key or the topic, as it was configured."""
        return self.key or self.topic or ""

    @property
    def sensor(self) -> str:
        """The sensor's name in every pair that it belongs to: `name`, or `place` if it has none."""
        return str(getattr(self, "name", None) or self.place)

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, document: Any) -> Any:
        """A text is the name of a topic, and frames on topics are CDR."""
        if isinstance(document, str):
            document = {"topic": document}
        if isinstance(document, dict) and document.get("topic") is not None:
            if document.get("encoding", "cdr") != "cdr":
                raise ValueError("what comes on a topic is CDR: leave `encoding` out")
            document = {**document, "encoding": "cdr"}
        return document

    @model_validator(mode="after")
    def _key_or_topic(self) -> Self:
        if (self.key is None) == (self.topic is None):
            raise ValueError("give `key`, a key of Zenoh, or `topic`, a name of ROS 2 that begins with /: one of them")
        return self


class OpenCameraConfig(StreamConfig):
    """Camera stream of a pair that may leave out the camera's calibration, to be found on ROS 2 topics."""

    name: Name | None = Field(default=None, description="name of the camera, the same in all its pairs; `links` use it")

    frame_id: str | None = Field(default=None, max_length=128, description="images with another frame id are refused")
    type: CameraMessage | None = Field(
        default=None,
        description="type of CDR messages that do not name theirs; by default CompressedImage, or Image on a topic "
        "whose name does not end with /compressed. If set, a topic's messages must have this type",
    )
    intrinsics: CameraIntrinsics | None = Field(default=None, description="intrinsics of the images as they come")
    info_topic: TopicName | None = Field(
        default=None,
        description="topic of the `CameraInfo` that gives omitted intrinsics; by default `camera_info` beside the "
        "images",
    )
    mask: FilePath | None = Field(default=None, description="PNG of the image's size, 0 = ignore this pixel")
    hardware_id: str | None = Field(
        default=None, max_length=128, description="serial number of the camera, for ROS diagnostics; null: vehicle/pair"
    )

    @property
    def assumed_type(self) -> CameraMessage:
        """The type of messages that do not name theirs."""
        if self.type is not None:
            return self.type
        is_raw = self.topic is not None and not self.topic.endswith("/compressed")
        return "sensor_msgs/msg/Image" if is_raw else "sensor_msgs/msg/CompressedImage"

    @property
    def types(self) -> tuple[str, ...]:
        """The message types that this stream accepts."""
        return _types(CameraMessage, self.type if self.topic else None)


class CameraConfig(OpenCameraConfig):
    """Camera stream of a pair."""

    frame_id: str = Field(default="camera", max_length=128, description="images with another frame id are refused")
    intrinsics: CameraIntrinsics


class OpenLidarConfig(StreamConfig):
    """LiDAR stream of a pair that may leave out the LiDAR's frames, to be found on ROS 2 topics."""

    name: Name | None = Field(default=None, description="name of the LiDAR, the same in all its pairs; `links` use it")
    type: LidarMessage | PacketMessage | None = Field(
        default=None,
        description="type of CDR messages that do not name theirs; by default PointCloud2. If set, a topic's messages "
        "must have this type. Packets of a LiDAR are read if this names them, or if the name of the topic ends with "
        "`packets`",
    )
    metadata: FilePath | None = Field(
        default=None,
        description="of a LiDAR whose packets are read: its metadata (Ouster, JSON) or correction file (Hesai, CSV)",
    )
    metadata_topic: TopicName | None = Field(
        default=None,
        description="topic that gives omitted `metadata`; by default `metadata` and `lidar_corrections` beside the "
        "packets",
    )
    frame_id: str | None = Field(
        default=None, max_length=128, description="frame of the LiDAR; clouds with another frame id are refused"
    )
    T_cloud_lidar: Matrix4x4 | None = Field(
        default=None, description="pose of the LiDAR in the frame of the points that its driver sends"
    )
    cloud_frame_id: str | None = Field(
        default=None, max_length=128, description="frame of the clouds as they come, if it is not the LiDAR's"
    )
    source: int | None = Field(
        default=None,
        ge=-(2**31),
        lt=2**32,
        description="if a cloud holds several LiDARs: this one's number in the field that tells them apart (lidar_id, "
        "sensor_id, source_id, device_id or source)",
    )
    sweep: SweepConfig | None = Field(default=None, description="needed for clouds without per-point time")
    time: PointTimeConfig | None = Field(
        default=None, description="time of the points of ROS clouds; by default recognised from the values"
    )

    @property
    def has_packets(self) -> bool:
        """Whether packets of a LiDAR are expected."""
        return self.place.endswith("packets") if self.type is None else self.type in get_args(PacketMessage)

    @property
    def metadata_topics(self) -> tuple[str, ...]:
        """Topics on which the LiDAR whose packets are read may say what it is."""
        if self.topic is None or not self.has_packets or self.metadata is not None:
            return ()
        namespace = self.topic.rpartition("/")[0]
        usual = (f"{namespace}/metadata", f"{namespace}/lidar_corrections")
        return (self.metadata_topic,) if self.metadata_topic else usual

    @property
    def assumed_type(self) -> str:
        """The type of messages that do not name theirs."""
        return self.type or "sensor_msgs/msg/PointCloud2"

    @property
    def types(self) -> tuple[str, ...]:
        """The message types that this stream accepts."""
        if self.topic is not None and self.type is not None:
            return (self.type,)
        return (*get_args(LidarMessage), *(get_args(PacketMessage) if self.has_packets else ()))


class LidarConfig(OpenLidarConfig):
    """LiDAR stream of a pair."""

    frame_id: str = Field(
        default="lidar", max_length=128, description="frame of the LiDAR; clouds with another frame id are refused"
    )
    T_cloud_lidar: Matrix4x4 = Field(
        default=IDENTITY, description="pose of the LiDAR in the frame of the points that its driver sends"
    )


class OpenEgoConfig(StreamConfig):
    """Ego-motion stream of a pair that may leave out the pose of its frame, to be found on ROS 2 topics."""

    type: EgoMessage | None = Field(
        default=None,
        description="type of CDR messages that do not name theirs; by default Odometry. If set, a topic's messages "
        "must have this type",
    )
    T_lidar_ego: Matrix4x4 | None = Field(default=None, description="maps ego-frame to LiDAR coordinates")
    parent: str = Field(
        default="odom", min_length=1, max_length=128, description="frame in which the vehicle moves (TFMessage)"
    )
    child: str = Field(
        default="base_link", min_length=1, max_length=128, description="frame of the vehicle (TFMessage)"
    )
    motion: Literal["twist", "pose"] | None = Field(
        default=None,
        description="from what of an Odometry the motion is taken: its twist, or differences of its pose; by default "
        "the twist, unless the poses show that it is not meant as stated",
    )

    @property
    def assumed_type(self) -> EgoMessage:
        """The type of messages that do not name theirs."""
        return self.type or "nav_msgs/msg/Odometry"

    @property
    def types(self) -> tuple[str, ...]:
        """The message types that this stream accepts."""
        return _types(EgoMessage, self.type if self.topic else None)


class EgoConfig(OpenEgoConfig):
    """Ego-motion stream of a pair."""

    T_lidar_ego: Matrix4x4 = Field(default=IDENTITY, description="maps ego-frame to LiDAR coordinates")


AnyStreamConfig = OpenCameraConfig | OpenLidarConfig | OpenEgoConfig
KnownStreamConfig = CameraConfig | LidarConfig | EgoConfig


def _types(known: Any, only: str | None) -> tuple[str, ...]:
    """The values of a `Literal`, or only the one that was configured."""
    return get_args(known) if only is None else (only,)


class OpenPairConfig(ConfigModel):
    """One camera-LiDAR pair that may leave out what the service can read from ROS 2 topics: the frames of its sensors,
    the intrinsics (`CameraInfo`) and the poses between the sensors (`/tf_static`). `points: TEXT` is short for
    `lidar: {topic: TEXT}`."""

    name: Name = Field(description="name of the pair, part of its keys and file names")
    camera: OpenCameraConfig
    lidar: OpenLidarConfig
    ego: OpenEgoConfig | None = None
    T_camera_lidar: WrittenPose | None = Field(
        default=None, description="workshop calibration: LiDAR to camera; or its inverse as `T_lidar_camera`"
    )
    pairing: stages.PairingConfig = stages.PairingConfig()
    window: stages.WindowConfig = stages.WindowConfig()
    calibration: stages.CalibrationConfig = stages.CalibrationConfig()
    monitor: stages.MonitorConfig = stages.MonitorConfig()
    policy: stages.PolicyConfig = stages.PolicyConfig()
    tracker: stages.TrackerConfig = stages.TrackerConfig()

    @property
    def streams(self) -> Mapping[str, AnyStreamConfig]:
        """Those that it has, by the names under which they are counted."""
        streams = {"camera": self.camera, "lidar": self.lidar, "ego": self.ego}
        return {name: stream for name, stream in streams.items() if stream is not None}

    @model_validator(mode="before")
    @classmethod
    def _with_direction(cls, document: Any) -> Any:
        return with_direction(document) if isinstance(document, dict) and "T_lidar_camera" in document else document

    @model_validator(mode="before")
    @classmethod
    def _points_as_lidar(cls, document: Any) -> Any:
        if not isinstance(document, dict) or "points" not in document:
            return document
        points = document["points"]
        if not isinstance(points, str) or "lidar" in document:
            raise ValueError("`points` is the name of a topic, short for `lidar: {topic: ...}`: give one of the two")
        return {**{name: value for name, value in document.items() if name != "points"}, "lidar": points}


class PairConfig(OpenPairConfig):
    """One camera-LiDAR pair whose description is complete."""

    camera: CameraConfig
    lidar: LidarConfig
    ego: EgoConfig | None = None
    T_camera_lidar: WrittenPose = Field(
        description="workshop calibration: LiDAR to camera; or its inverse as `T_lidar_camera`"
    )

    @property
    def streams(self) -> Mapping[str, KnownStreamConfig]:
        """Those that it has, by the names under which they are counted."""
        streams = {"camera": self.camera, "lidar": self.lidar, "ego": self.ego}
        return {name: stream for name, stream in streams.items() if stream is not None}
