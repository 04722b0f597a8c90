"""Everything a user may set, with its default, unit and reason: one frozen model per stage, unknown keys refused.

`load_config` reads the one YAML file of a daemon. The same stage models (`WindowConfig`, `CalibrationConfig`, ...)
serve the command line, so a default exists once.
"""

from __future__ import annotations

import hashlib
import ipaddress
import json
import os
import re
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import YAMLError

from coec.errors import ConfigError
from coec.schemas.commands import NAMES, CommandName
from coec.schemas.ros_names import ros_name

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
"""A name that becomes one chunk of a Zenoh key and part of a file name."""

KeyExpression = Annotated[str, Field(pattern=r"^[^\s/*$?#]+(/[^\s/*$?#]+)*$", max_length=256)]
"""A Zenoh key without wildcards, and without empty chunks."""

MAX_NAME_BYTES = 255
"""Of one name in a path: what Linux's file systems take (limits.h, NAME_MAX)."""

MAX_PATH_BYTES = 2048
"""Of a path: half of what Linux takes (limits.h, PATH_MAX); the folder that it is relative to may have the rest."""


def _path(path: Path) -> Path:
    if "\0" in str(path) or any(len(os.fsencode(name)) > MAX_NAME_BYTES for name in path.parts):
        raise ValueError(f"a name in a path has no zero byte, and at most {MAX_NAME_BYTES} bytes")
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise ValueError(f"a path has at most {MAX_PATH_BYTES} bytes")
    return path


FilePath = Annotated[Path, AfterValidator(_path)]
"""A path that can be asked for. What a text file says may be none, and Python raises whatever it likes about it."""

Matrix4x4 = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]

IDENTITY: Matrix4x4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class Stage(BaseModel):
    """Base of every configuration model: frozen, no unknown keys, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


# --- the rig --------------------------------------------------------------------------------------------------------


class CameraIntrinsics(Stage):
    """Intrinsics as in `dataset.yaml`; which of the optional parameters are needed depends on `model`."""

    model: Literal["pinhole", "radtan", "rational", "kannala_brandt", "mei", "eucm", "double_sphere"]
    width: int = Field(gt=0, le=16384, description="image width, px")
    height: int = Field(gt=0, le=16384, description="image height, px")
    fx: float = Field(gt=0, description="focal length, px")
    fy: float = Field(gt=0, description="focal length, px")
    cx: float = Field(description="principal point, px; pixel centres at integers")
    cy: float = Field(description="principal point, px; pixel centres at integers")
    xi: float | None = None
    alpha: float | None = None
    beta: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None

    def parameters(self) -> dict[str, float]:
        """Every intrinsic that was given, by name, without `model`."""
        return self.model_dump(exclude={"model"}, exclude_none=True)


class SweepConfig(Stage):
    """Azimuth timing of a spinning LiDAR without per-point time: a point at azimuth a was measured
    `sign · wrap(a - stamp_azimuth_deg) / 360°` revolutions after the stamp."""

    period_s: float = Field(default=0.1, gt=0, le=10, description="one revolution, s")
    sign: Literal[-1, 1] = Field(default=-1, description="-1 clockwise seen from above, 1 counter-clockwise")
    stamp_azimuth_deg: float = Field(default=0.0, ge=-360, le=360, description="azimuth that is measured at the stamp")


TimeUnit = Literal["s", "ms", "us", "ns"]
TimeBase = Literal["stamp", "clock"]


class PointTimeConfig(Stage):
    """How the points of a `PointCloud2` are timed, where their values leave it open."""

    field: str = Field(min_length=1, max_length=64, description="name of the field")
    unit: TimeUnit
    base: TimeBase = Field(
        default="stamp", description="counted since the cloud's stamp, or on the clock that its stamp is of"
    )


Encoding = Literal["msgpack", "cdr"]

TopicName = Annotated[str, Field(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$", max_length=247)]
"""A full name of a topic of ROS 2 (rmw/validate_full_topic_name.h)."""

CameraMessage = Literal["sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"]
LidarMessage = Literal["sensor_msgs/msg/PointCloud2"]
EgoMessage = Literal[
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
    "sensor_msgs/msg/Imu",
    "tf2_msgs/msg/TFMessage",
]


class StreamConfig(Stage):
    """Where the samples of a stream come from; one text alone is short for its `topic`."""

    key: KeyExpression | None = Field(default=None, description="Zenoh key of the frames")
    topic: TopicName | None = Field(
        default=None, description="of ROS 2, instead of a key, where `middleware` is one of its; its frames are CDR"
    )
    encoding: Encoding = Field(default="msgpack", description="assumed when a sample names no encoding")

    @property
    def place(self) -> str:
        """The key or the topic, as it was configured."""
        return self.key or self.topic or ""

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, document: Any) -> Any:
        """A text is the name of a topic, and what comes on topics is CDR."""
        if isinstance(document, str):
            document = {"topic": document}
        if isinstance(document, dict) and document.get("topic") is not None:
            if document.get("encoding", "cdr") != "cdr":
                raise ValueError("what comes on a topic is CDR: leave `encoding` out")
            document = {**document, "encoding": "cdr"}
        return document

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.key is None) == (self.topic is None):
            raise ValueError("give `key`, a key of Zenoh, or `topic`, a name of ROS 2 that begins with /: one of them")
        return self


class OpenCameraConfig(StreamConfig):
    """Camera stream of a pair, which may leave its calibration to be found."""

    frame_id: str | None = Field(default=None, max_length=128, description="frames of another id are refused")
    type: CameraMessage | None = Field(
        default=None,
        description="of CDR that does not say its own; unless set CompressedImage, and Image where the name of a topic "
        "does not end with /compressed. What comes on a topic must have it, if it is set",
    )
    intrinsics: CameraIntrinsics | None = Field(default=None, description="of the images as they come")
    info_topic: TopicName | None = Field(
        default=None,
        description="of the `CameraInfo` that tells intrinsics left out; unless set, `camera_info` beside the images",
    )
    mask: FilePath | None = Field(default=None, description="PNG of the image's size, 0 = ignore this pixel")
    hardware_id: str | None = Field(
        default=None, max_length=128, description="its serial number, for ROS diagnostics; null: vehicle/pair"
    )

    @property
    def assumed_type(self) -> CameraMessage:
        """The type of messages that do not say theirs."""
        if self.type is not None:
            return self.type
        is_raw = self.topic is not None and not self.topic.endswith("/compressed")
        return "sensor_msgs/msg/Image" if is_raw else "sensor_msgs/msg/CompressedImage"

    @property
    def types(self) -> tuple[str, ...]:
        """Types of messages that this stream takes."""
        return _types(CameraMessage, self.type if self.topic else None)


class CameraConfig(OpenCameraConfig):
    """Camera stream of a pair."""

    frame_id: str = Field(default="camera", max_length=128, description="frames of another id are refused")
    intrinsics: CameraIntrinsics


class OpenLidarConfig(StreamConfig):
    """LiDAR stream of a pair, which may leave its frames to be found."""

    frame_id: str | None = Field(
        default=None, max_length=128, description="of the LiDAR; clouds of another id are refused"
    )
    T_cloud_lidar: Matrix4x4 | None = Field(
        default=None, description="pose of the LiDAR in the frame in which its driver gives the points"
    )
    cloud_frame_id: str | None = Field(
        default=None, max_length=128, description="of the clouds as they come, where it is not that of the LiDAR"
    )
    source: int | None = Field(
        default=None,
        ge=-(2**31),
        lt=2**32,
        description="of a cloud of several LiDARs: this one's number in the field that tells them apart (lidar_id, "
        "sensor_id, source_id, device_id or source)",
    )
    sweep: SweepConfig | None = Field(default=None, description="needed for clouds without per-point time")
    time: PointTimeConfig | None = Field(
        default=None, description="of clouds of ROS; unless set it is recognised from the values"
    )

    @property
    def assumed_type(self) -> LidarMessage:
        """The type of messages that do not say theirs."""
        return "sensor_msgs/msg/PointCloud2"

    @property
    def types(self) -> tuple[str, ...]:
        """Types of messages that this stream takes."""
        return _types(LidarMessage, None)


class LidarConfig(OpenLidarConfig):
    """LiDAR stream of a pair."""

    frame_id: str = Field(default="lidar", max_length=128, description="of the LiDAR; clouds of another id are refused")
    T_cloud_lidar: Matrix4x4 = Field(
        default=IDENTITY, description="pose of the LiDAR in the frame in which its driver gives the points"
    )


class OpenEgoConfig(StreamConfig):
    """Ego-motion stream of a pair, which may leave its place to be found."""

    type: EgoMessage | None = Field(
        default=None,
        description="of CDR that does not say its own; Odometry unless set. What comes on a topic must have it, if set",
    )
    T_lidar_ego: Matrix4x4 | None = Field(default=None, description="maps ego-frame to LiDAR coordinates")
    parent: str = Field(
        default="odom", min_length=1, max_length=128, description="frame in which the vehicle moves (TFMessage)"
    )
    child: str = Field(
        default="base_link", min_length=1, max_length=128, description="frame of the vehicle (TFMessage)"
    )

    @property
    def assumed_type(self) -> EgoMessage:
        """The type of messages that do not say theirs."""
        return self.type or "nav_msgs/msg/Odometry"

    @property
    def types(self) -> tuple[str, ...]:
        """Types of messages that this stream takes."""
        return _types(EgoMessage, self.type if self.topic else None)


class EgoConfig(OpenEgoConfig):
    """Ego-motion stream of a pair."""

    T_lidar_ego: Matrix4x4 = Field(default=IDENTITY, description="maps ego-frame to LiDAR coordinates")


AnyStreamConfig = OpenCameraConfig | OpenLidarConfig | OpenEgoConfig


def _types(known: Any, only: str | None) -> tuple[str, ...]:
    """Those of a `Literal`, or the one that was asked for."""
    return get_args(known) if only is None else (only,)


# --- stages of the calibration
# -----------------------------------------------------------------------------------------


class PairingConfig(Stage):
    """Which camera frame belongs to which sweep."""

    tolerance_s: float = Field(default=0.05, gt=0, le=1, description="largest stamp difference; half a 10 Hz period")
    motion_tolerance_s: float = Field(
        default=0.2, gt=0, le=5, description="largest distance of a pair from the nearest ego-motion sample"
    )
    queue_frames: int = Field(
        default=16, ge=2, le=256, description="frames kept per stream while they wait for partners"
    )
    max_stamp_jump_s: float = Field(
        default=300.0, gt=0, description="a stamp further from its predecessor is refused, until five agree"
    )


MAX_SLICE_S = 3600.0
"""Longest slice, s: within an hour, light and weather are those of one drive."""


class WindowConfig(Stage):
    """How a window is chosen from the stream (the paper: 25 pairs over three minutes)."""

    pairs: int = Field(default=25, ge=1, le=400)
    min_pairs: int = Field(default=10, ge=1, le=400, description="a slice that ends with fewer makes no window")
    slice_s: float = Field(default=180.0, gt=0, le=MAX_SLICE_S)
    require_motion: bool = Field(default=True, description="skip pairs taken while the vehicle is known to stand")
    min_speed_mps: float = Field(default=0.5, ge=0, description="slower counts as standing")
    min_sharpness: float = Field(
        default=0.008,
        ge=0,
        description="gradient energy over contrast, 0 to 1; sharp: 0.011 to 0.057, blurred by 4 px: below 0.006",
    )
    min_mean_level: float = Field(default=8.0, ge=0, le=255, description="mean grey value; darker tells nothing")
    max_clipped: float = Field(
        default=0.6, gt=0, le=1, description="share of black or white pixels; a covered or blinded lens"
    )
    min_points_in_view: int = Field(default=500, ge=1, description="LiDAR points in the image at the current extrinsic")

    @model_validator(mode="after")
    def _counts_agree(self) -> WindowConfig:
        if self.min_pairs > self.pairs:
            raise ValueError("min_pairs must not exceed pairs")
        return self


class DepthConfig(Stage):
    """The depth network."""

    model: str = Field(
        default="street", description="an ONNX file, a built-in name, or `stereo` (maps that come with the frames)"
    )
    providers: tuple[Literal["cpu", "cuda", "tensorrt"], ...] = Field(
        default=("cpu",), min_length=1, description="tried in this order; cpu is always the last resort"
    )
    threads: int = Field(default=2, ge=1, le=64)


class ObjectiveConfig(Stage):
    """Equation (1) and the guard against looking away."""

    kind: Literal["mi", "fused", "intensity"] = Field(
        default="fused",
        description="fused: edges and depth, from far away; mi: the paper's; intensity: reflectance against grey value",
    )
    depth_bins: int = Field(default=32, ge=2, le=4096)
    range_bins: int = Field(default=32, ge=2, le=4096)
    min_range_m: float = Field(default=2.0, ge=0, description="nearer points are the vehicle itself")
    max_range_m: float = Field(default=80.0, gt=0, description="further points are too sparse to carry information")

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> ObjectiveConfig:
        if self.min_range_m >= self.max_range_m:
            raise ValueError("min_range_m must be below max_range_m")
        return self


class SearchConfig(Stage):
    """The box and the steps of BOBYQA."""

    dof: Literal[3, 6] = 3
    rotation_deg: float = Field(
        default=10.0, gt=0, le=45, description="half-width of the box about the start, per axis"
    )
    translation_m: float = Field(default=0.3, gt=0, le=2, description="half-width of the box about the start, per axis")
    step_deg: float = Field(default=2.0, gt=0, description="first trust region, rotation")
    step_m: float = Field(default=0.05, gt=0, description="first trust region, translation")
    tolerance_deg: float = Field(default=0.002, gt=0, description="last trust region, rotation")
    max_evaluations: int = Field(default=600, ge=20, le=100_000)
    reach_deg: float = Field(
        default=28.0, gt=0, le=60, description="radius of the global stage about the start (fused)"
    )
    reach_m: float = Field(default=0.65, gt=0, le=2, description="radius of the global stage about the start (fused)")


class VerdictConfig(Stage):
    """Limits of equation (2) for a rig that is not commissioned yet. All are ratios of the window to itself, so that
    they do not depend on the scene, the bins or the network."""

    min_mi_over_unrelated: float = Field(default=1.2, gt=0, description="MI over the MI with other frames' depth maps")
    max_newton_step_deg: float = Field(default=0.25, gt=0, description="|f'|/f'': distance to the zero of f', degrees")
    max_newton_step_m: float = Field(default=0.02, gt=0, description="|f'|/f'' of the translations, metres (6 dof)")
    max_sigma_deg: float = Field(default=0.3, gt=0, description="largest standard deviation of a rotation, degrees")
    max_sigma_m: float = Field(default=0.1, gt=0, description="largest standard deviation of a translation, m (6 dof)")
    min_peakedness_per_deg2: float = Field(default=0.01, description="f''/score, per degree²; least of the rotations")
    min_overlap: float = Field(
        default=0.5, ge=0, le=1, description="points in view over the most any pose of the box sees"
    )
    min_range_edges: int = Field(
        default=1000,
        ge=1,
        description="independent range jumps of the window's sweeps, with 6 dof twice as many; a few hundred fit wrong "
        "poses by chance (fused)",
    )
    min_edge_contrast: float = Field(
        default=6.0, gt=0, description="edge significance, in standard deviations of that of other poses (fused)"
    )
    max_runner_up: float = Field(
        default=0.85,
        gt=0,
        le=1,
        description="edge contrast of the next best basin over the best one's; above: ambiguous",
    )
    max_change_gain: float = Field(
        default=3.5,
        gt=0,
        description="what two poses, one after the other, may score more than one, in standard deviations of a frame's "
        "score; above: the camera moved within the window (fused)",
    )
    max_intrinsics_certainty: float = Field(
        default=2.0,
        gt=0,
        description="certainty with which another lens may explain the window better, half a standard deviation each; "
        "from 1.5 on σ grows by what that lens moves, above this the intrinsics are off (fused)",
    )
    held_translation_sigma_m: float = Field(
        default=0.01,
        ge=0,
        description="how well the camera's centre is known along each axis where it is not searched: standard "
        "deviation of a mount that was measured with a rule or taken from a drawing, m",
    )
    min_change_deg: float = Field(
        default=0.25, ge=0, description="a smaller turn within a window does not refuse it (fused)"
    )


class TimeOffsetConfig(Stage):
    """When the offset between the clocks of camera and LiDAR counts as observed."""

    reach_s: float = Field(default=0.1, gt=0, le=0.5, description="largest offset looked for, s")
    min_turn_spread_deg_per_s: float = Field(
        default=2.5, gt=0, description="least spread of the turn rate over the frames; less is a straight drive"
    )
    translation_sigma_m: float = Field(
        default=0.05, ge=0, description="how well the mount's position is known: driving on, 5 cm look like 5 ms"
    )
    floor_s: float = Field(default=0.001, ge=0, description="time of exposure, trigger and ego-motion are off by, s")
    max_sigma_s: float = Field(default=0.008, gt=0, description="largest standard deviation of an offset observed, s")


class CalibrationConfig(Stage):
    """Everything that decides a result, given a window: its hash is the `config_hash` of the result."""

    depth: DepthConfig = DepthConfig()
    objective: ObjectiveConfig = ObjectiveConfig()
    search: SearchConfig = SearchConfig()
    verdict: VerdictConfig = VerdictConfig()
    time_offset: TimeOffsetConfig = TimeOffsetConfig()
    motion_compensation: bool = True


class TrackerConfig(Stage):
    """How accepted windows combine into the extrinsic that is served. Rotations per axis in degrees, translations in
    metres."""

    prior_deg: float = Field(default=10.0, gt=0, le=180, description="how far the first extrinsic may be off")
    prior_m: float = Field(default=0.3, gt=0, le=10, description="how far the first extrinsic may be off")
    drift_deg_per_sqrt_h: float = Field(
        default=0.01, ge=0, description="creep of the mount, a random walk; 0 = every window counts for ever"
    )
    drift_m_per_sqrt_h: float = Field(default=0.001, ge=0, description="the same for translations")
    step_false_alarm: float = Field(
        default=1e-4, gt=0, lt=1, description="a window less probable than this without a step raises suspicion"
    )
    overwhelming_false_alarm: float = Field(
        default=0.0, ge=0, lt=1, description="one less probable than this is taken without a second; 0 = never"
    )


# --- what is done about it ------------------------------------------------------------------------------------------


class MonitorConfig(Stage):
    """When the latest pairs are judged at the current extrinsic, between two windows."""

    period_s: float = Field(default=5.0, gt=0, le=86_400, description="one check per so much sensor time, s")
    pairs: int = Field(default=6, ge=4, le=10, description="pairs of one check, evenly over the period")
    min_pairs: int = Field(default=4, ge=4, le=10, description="with fewer the check waits for the next period")
    urgent_slice_s: float = Field(
        default=30.0, gt=0, le=3600, description="slice of the window that is taken as soon as the monitor suspects, s"
    )
    hours_between_false_alarms: float = Field(
        default=100.0, gt=0, description="a right mount is called moved by checks once in so many hours, or more rarely"
    )
    hours_between_false_suspicions: float = Field(
        default=2.0, gt=0, description="a right mount is suspected once in so many hours, or more rarely"
    )

    @model_validator(mode="after")
    def _counts_agree(self) -> MonitorConfig:
        if self.min_pairs > self.pairs:
            raise ValueError("min_pairs must not exceed pairs")
        if self.hours_between_false_suspicions > self.hours_between_false_alarms:
            raise ValueError("hours_between_false_suspicions must not exceed hours_between_false_alarms")
        return self


class PolicyConfig(Stage):
    """What may become current without a person: an estimate is one thing, applying it another. What is not applied
    waits for `command/apply`. Limits are per axis; those of a day count every step of the last 24 h of sensor time."""

    apply: Literal["never", "within_limits", "always"] = "within_limits"
    max_step_deg: float = Field(default=10.0, gt=0, description="largest step of a rotation, degrees (within_limits)")
    max_step_m: float = Field(default=0.3, gt=0, description="largest step of a translation, m (within_limits)")
    max_per_day_deg: float = Field(default=20.0, gt=0, description="sum of all steps of a day, degrees (within_limits)")
    max_per_day_m: float = Field(default=0.6, gt=0, description="sum of all steps of a day, m (within_limits)")
    agree_deg: float = Field(
        default=0.3, gt=0, description="an accepted estimate nearer than this confirms what is served, degrees"
    )
    agree_m: float = Field(default=0.1, gt=0, description="an accepted estimate nearer than this confirms it, m")


# --- the daemon -----------------------------------------------------------------------------------------------------


class OpenPairConfig(Stage):
    """One camera-LiDAR pair that may leave to be found what topics of ROS 2 tell: the frames of its sensors, the
    intrinsics (`CameraInfo`) and how the sensors lie to one another (`/tf_static`). `points: TEXT` is short for
    `lidar: {topic: TEXT}`."""

    name: Name
    camera: OpenCameraConfig
    lidar: OpenLidarConfig
    ego: OpenEgoConfig | None = None
    T_camera_lidar: Matrix4x4 | None = Field(default=None, description="workshop calibration: LiDAR to camera")
    pairing: PairingConfig = PairingConfig()
    window: WindowConfig = WindowConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    monitor: MonitorConfig = MonitorConfig()
    policy: PolicyConfig = PolicyConfig()
    tracker: TrackerConfig = TrackerConfig()

    @property
    def streams(self) -> dict[str, AnyStreamConfig]:
        """Those that it has, by the names under which they are counted."""
        streams = {"camera": self.camera, "lidar": self.lidar, "ego": self.ego}
        return {name: stream for name, stream in streams.items() if stream is not None}

    @model_validator(mode="before")
    @classmethod
    def _points_are_the_lidars(cls, document: Any) -> Any:
        if not isinstance(document, dict) or "points" not in document:
            return document
        points = document["points"]
        if not isinstance(points, str) or "lidar" in document:
            raise ValueError("`points` is the name of a topic, short for `lidar: {topic: ...}`: give one of the two")
        return {**{name: value for name, value in document.items() if name != "points"}, "lidar": points}


class PairConfig(OpenPairConfig):
    """One camera-LiDAR pair of which everything is known."""

    camera: CameraConfig
    lidar: LidarConfig
    ego: EgoConfig | None = None
    T_camera_lidar: Matrix4x4 = Field(description="workshop calibration: LiDAR to camera")


class LimitsConfig(Stage):
    """Hard limits on what a message may hold: larger is refused before it is decoded."""

    max_message_bytes: int = Field(default=32 * 2**20, ge=2**16, le=2**30, description="as Zenoh's max_message_size")
    max_image_pixels: int = Field(default=33_000_000, ge=2**12, description="8K UHD")
    max_points: int = Field(default=1_000_000, ge=2**10)
    max_waiting_bytes: int = Field(
        default=64 * 2**20,
        ge=2**20,
        description="per pair, messages that have come and wait to be decoded; beyond, the oldest are lost",
    )
    max_held_bytes: int = Field(
        default=256 * 2**20,
        ge=2**20,
        description="per pair, frames that wait until what was seen before them is judged; beyond, they do not wait",
    )


class StateConfig(Stage):
    """The state directory; deleting it returns the vehicle to nominal."""

    directory: FilePath = Path("coec-state")
    max_bytes: int = Field(default=4 * 2**30, ge=2**20, description="windows kept, bytes; the oldest go first")
    max_age_days: float = Field(default=90.0, gt=0)
    min_free_bytes: int = Field(
        default=512 * 2**20, ge=0, description="left free on the disk; no window starts below it"
    )
    history: int = Field(default=500, ge=1, le=10_000, description="kept per pair: results, states, commands, each")
    checks: int = Field(default=2000, ge=1, le=100_000, description="checks of the monitor kept per pair, 2 kB each")
    evidence: int = Field(default=8, ge=1, le=100, description="red events kept per pair, with their windows")


class BudgetConfig(Stage):
    """What the pairs may spend of the processor between them. Where it does not suffice for every check and every
    window, their periods stretch evenly, and `status` says by how much."""

    cores: float = Field(
        default=0.5,
        gt=0,
        le=64,
        description="processor time of the worker in a second of driving, s: a replay at ten times the pace of the "
        "drive spends ten times as much, and is checked as often",
    )


class WorkerConfig(Stage):
    """The process that infers and solves."""

    timeout_s: float = Field(default=120.0, gt=0, description="one job; a worker that needs longer is replaced")
    max_memory_bytes: int = Field(default=3 * 2**30, ge=2**28, description="resident; a worker above is replaced")
    attempts: int = Field(
        default=2, ge=1, le=10, description="workers that may die on one window before it is given up"
    )
    threads: int = Field(default=2, ge=1, le=64)
    niceness: int = Field(default=10, ge=0, le=19, description="so that queries are answered first")


class ZenohConfig(Stage):
    """The session. `file` is a Zenoh configuration (JSON5) for TLS, access control and the like."""

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    embedded_router: bool = Field(default=False, description="be the router and listen on `listen`")
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    insecure: bool = Field(
        default=False, description="listen even where whoever comes is let in without a certificate; health says so"
    )
    file: FilePath | None = None

    @property
    def router(self) -> tuple[str, ...]:
        """Endpoints at which a client reaches the router that the service uses, or is."""
        return self.listen if self.embedded_router else self.connect


RosOutput = Literal["diagnostics", "tf_static", "camera_info", "overlay"]


class RosConfig(Stage):
    """ROS 2 on the bus, where `middleware` is one of its."""

    domain: int = Field(default=0, ge=0, le=232, description="ROS_DOMAIN_ID (rmw_zenoh)")
    namespace: str = Field(
        default="",
        pattern=r"^(/?[A-Za-z_][A-Za-z0-9_]*)*$",
        max_length=128,
        description="of the bridge, where it has one (ros2dds)",
    )
    publish: tuple[RosOutput, ...] = Field(
        default=(), description="what ROS nodes are told: diagnostics, tf_static, camera_info, overlay"
    )
    calibrated_suffix: str = Field(
        default="_calibrated",
        pattern=r"^[A-Za-z0-9_]+$",
        max_length=64,
        description="of the camera's frame whose transform is published: the vehicle's tree owns the camera's own",
    )
    replace_camera_frames: bool = Field(
        default=False,
        description="publish the camera's own frame instead; nobody else may, as a frame has one parent",
    )

    @model_validator(mode="after")
    def _each_once(self) -> RosConfig:
        if len(set(self.publish)) != len(self.publish):
            raise ValueError("publish names something twice")
        return self


CommonName = Annotated[str, Field(pattern=r"^[A-Za-z0-9 ._:/@+=,-]{1,64}$")]
"""Of a certificate; X.509 allows 64 characters."""


class SenderConfig(Stage):
    """Somebody who may give commands, by the common name of his certificate."""

    name: CommonName
    commands: tuple[CommandName, ...] = Field(default=NAMES, min_length=1)


class AuthorityConfig(Stage):
    """Who may give commands, whatever the router lets through. A router tells the service nothing of who asks: whoever
    is to be known proves it to the service itself, by a certificate of `root_ca`, in a TLS conversation inside the
    query (`coec query command/...` does). A router in between can only keep such a command back. `anonymous` are all
    others; `loopback` takes theirs while the session listens and connects on loopback only, and its router's port is
    open nowhere else. What other doors that router has the service cannot see: where it has some, they are what its own
    access control lets in, or `never` shuts them."""

    anonymous: Literal["never", "loopback", "always"] = "loopback"
    senders: tuple[SenderConfig, ...] = Field(default=(), max_length=64, description="by `name`, and their `commands`")
    certificate: FilePath | None = Field(
        default=None, description="of the service; its common name is the vehicle's name"
    )
    private_key: FilePath | None = Field(default=None, description="of the certificate")
    root_ca: FilePath | None = Field(default=None, description="the authority that signed the senders' certificates")

    @model_validator(mode="after")
    def _provable(self) -> AuthorityConfig:
        given = [path is not None for path in (self.certificate, self.private_key, self.root_ca)]
        if any(given) != all(given):
            raise ValueError("certificate, private_key and root_ca belong together: give all three or none")
        if self.senders and not all(given):
            raise ValueError("senders prove their names to the service: give certificate, private_key and root_ca, too")
        names = [sender.name for sender in self.senders]
        if len(set(names)) != len(names):
            raise ValueError("names of senders must be unique")
        return self


class LogConfig(Stage):
    """The log, on standard output."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    format: Literal["auto", "json", "human"] = Field(
        default="auto", description="auto: for people where it goes to a terminal, else JSON lines"
    )


class MetricsConfig(Stage):
    """HTTP for a scraper on the same computer: `/metrics` (OpenMetrics) and `/health` (200, or 503 when a
    calibration is not known to be right). Whoever reaches it reads; nobody changes anything."""

    http: str | None = Field(default=None, description="HOST:PORT, as 127.0.0.1:9464; null: nobody listens")
    insecure: bool = Field(default=False, description="listen on other addresses than loopback, too; health says so")

    @property
    def address(self) -> tuple[str, int] | None:
        """Host, without brackets, and port; None: nobody listens."""
        if self.http is None:
            return None
        host, _, port = self.http.rpartition(":")
        return host.removeprefix("[").removesuffix("]"), int(port)

    @property
    def is_open(self) -> bool:
        """Whether other computers may get in."""
        return self.address is not None and not is_loopback(self.address[0])

    @model_validator(mode="after")
    def _nobody_from_outside(self) -> MetricsConfig:
        if self.http is None:
            return self
        if not re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[^\s:\[\]]+):\d{1,5}", self.http) or not 0 < self._port < 65536:
            raise ValueError(f"http: {self.http!r} is no HOST:PORT: write 127.0.0.1:9464")
        if self.is_open and not self.insecure:
            raise ValueError(
                f"http: whoever reaches {self.http} would read the metrics, without a certificate: listen on loopback, "
                "as 127.0.0.1:9464, or set `metrics.insecure: true`, and health will say so"
            )
        return self

    @property
    def _port(self) -> int:
        return 0 if self.address is None else self.address[1]


MAX_PAIRS = 32


class Config(Stage):
    """The one configuration file of a daemon."""

    vehicle: Name = "vehicle"
    prefix: KeyExpression = "coec"
    zenoh: ZenohConfig = ZenohConfig()
    middleware: Literal["native", "rmw_zenoh", "ros2dds"] = Field(
        default="native", description="how topics lie on the bus: native keys, or as ROS 2 nodes or a bridge put them"
    )
    ros: RosConfig = RosConfig()
    authority: AuthorityConfig = AuthorityConfig()
    state: StateConfig = StateConfig()
    worker: WorkerConfig = WorkerConfig()
    budget: BudgetConfig = BudgetConfig()
    limits: LimitsConfig = LimitsConfig()
    stale_after_s: float = Field(
        default=600.0, gt=0, description="age of the last completed check at which a pair is called stale, s"
    )
    log: LogConfig = LogConfig()
    metrics: MetricsConfig = MetricsConfig()
    pairs: tuple[PairConfig, ...] = Field(default=(), max_length=MAX_PAIRS)
    awaited: tuple[OpenPairConfig, ...] = Field(
        default=(),
        max_length=MAX_PAIRS,
        description="entries of `pairs` that leave out what topics of ROS 2 tell; each joins them when it is found",
    )

    @property
    def every_pair(self) -> tuple[OpenPairConfig, ...]:
        """Those of which everything is known, and then those that are awaited."""
        return (*self.pairs, *self.awaited)

    @model_validator(mode="before")
    @classmethod
    def _open_pairs_are_awaited(cls, document: Any) -> Any:
        if not isinstance(document, dict) or document.get("middleware", "native") == "native":
            return document
        pairs, awaited = document.get("pairs", ()), document.get("awaited", ())
        if not isinstance(pairs, list | tuple) or not isinstance(awaited, list | tuple):
            return document
        still = [pair for pair in pairs if _leaves_out(pair)]
        return {**document, "pairs": [pair for pair in pairs if pair not in still], "awaited": [*still, *awaited]}

    @model_validator(mode="after")
    def _some_pairs(self) -> Config:
        if not 0 < len(self.every_pair) <= MAX_PAIRS:
            raise ValueError(f"pairs: give 1 to {MAX_PAIRS}")
        if self.awaited and self.middleware == "native":
            raise ValueError("awaited: nothing tells what a pair leaves out where `middleware` is `native`")
        return self

    @model_validator(mode="after")
    def _names_unique(self) -> Config:
        names = [pair.name for pair in self.every_pair]
        if len(set(names)) != len(names):
            raise ValueError("pair names must be unique")
        return self

    @model_validator(mode="after")
    def _topics_need_ros(self) -> Config:
        if self.middleware != "native":
            return self
        topics = [f"pairs.{p.name}.{name}: {s.topic}" for p in self.pairs for name, s in p.streams.items() if s.topic]
        if topics:
            raise ValueError(
                f"{', '.join(topics)}: topics of ROS 2 are found where `middleware` is `rmw_zenoh` or `ros2dds`: set "
                "it, or give the Zenoh `key` of native frames instead"
            )
        return self

    @model_validator(mode="after")
    def _ros_can_be_told(self) -> Config:
        if not self.ros.publish:
            return self
        if self.middleware == "native":
            raise ValueError(
                "ros.publish: nobody is told of ROS topics on native keys: set `middleware` to `rmw_zenoh` or `ros2dds`"
            )
        tokens = [ros_name(pair.name) for pair in self.every_pair]
        if len(set(tokens)) != len(tokens):
            raise ValueError("ros.publish: names of pairs must differ in letters, digits or underscores: others are _")
        return self


def _leaves_out(pair: Any) -> bool:
    """Whether a pair, as it is written, leaves out what topics of ROS 2 tell."""
    if not isinstance(pair, dict):
        return False
    lidar, ego = pair.get("lidar", pair.get("points")), pair.get("ego")
    places = [(pair, "T_camera_lidar"), (pair.get("camera"), "intrinsics"), (pair.get("camera"), "frame_id")]
    places += [(lidar, "frame_id"), *([] if ego is None else [(ego, "T_lidar_ego")])]
    return any(isinstance(part, str) or (isinstance(part, dict) and part.get(name) is None) for part, name in places)


def is_loopback(host: str) -> bool:
    """Whether only this computer gets to an address, without brackets. A name but `localhost` does not count: who
    answers to it is not for us to know."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def config_hash(*parts: BaseModel | str) -> str:
    """First 16 hexadecimal digits of the sha256 over the canonical JSON of the parts."""
    canonical = [part if isinstance(part, str) else part.model_dump(mode="json") for part in parts]
    text = json.dumps(canonical, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


MAX_YAML_BYTES = 2**20
"""Of a YAML file; 10,000 frames of a manifest, or pairs beyond number. However few values it has, that is read in 1 s
(one core at 3 GHz)."""

MAX_YAML_DEPTH = 32
"""Of ours, none is nested deeper than 6."""

MAX_YAML_VALUES = 100_000
"""With the keys; each takes 35 µs to read. 5,200 frames of a manifest with a velocity each, 14,000 without."""

MERGE = "tag:yaml.org,2002:merge"


def load_yaml(path: Path) -> Any:
    """The document of a YAML 1.2 file.

    Raises:
        ConfigError: the file cannot be read or is not YAML.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_YAML_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    try:
        return parse_yaml(data.decode("utf-8"))
    except (ConfigError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid YAML: {error}") from error


def parse_yaml(text: str) -> Any:
    """The document of a YAML 1.2 text.

    Raises:
        ConfigError: it is not YAML, or larger or deeper than anything that a person writes.
    """
    if len(text) > MAX_YAML_BYTES:
        raise ConfigError(f"it has more than {MAX_YAML_BYTES} bytes")
    reader = YAML(typ="safe", pure=True)
    reader.max_depth = MAX_YAML_DEPTH
    reader.Composer = _Bounded
    try:
        document = reader.load(text)
    except ConfigError:
        raise
    except YAMLError as error:
        raise ConfigError(str(error)) from error
    except Exception as error:  # constructors of numbers, dates and the like raise whatever Python's own do
        raise ConfigError(f"a value in it is none: {type(error).__name__}") from error
    _check_extent(document)
    return document


class _Bounded(Composer):
    """Gives a document up when it has more values than ours have, not when all of them are read. Merge keys, which
    YAML 1.2 does not have, would copy values over and over."""

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader)
        self._values = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._values += 1
        if self._values > MAX_YAML_VALUES:
            raise ConfigError(f"it has more than {MAX_YAML_VALUES} values")
        node = super().compose_node(parent, index)
        if node.tag == MERGE:
            raise ConfigError("`<<` is no part of YAML 1.2: write the keys out, or give a whole value by its alias")
        return node


def _check_extent(document: object) -> None:
    """Aliases make little text a document without end: it is walked as whoever validates it will walk it."""
    waiting, values = [(document, 0)], 0
    while waiting:
        value, depth = waiting.pop()
        values += 1
        if depth > MAX_YAML_DEPTH or values > MAX_YAML_VALUES:
            raise ConfigError(f"it is nested deeper than {MAX_YAML_DEPTH}, or has more than {MAX_YAML_VALUES} values")
        if isinstance(value, dict):
            waiting += ((item, depth + 1) for item in value.values())
        elif isinstance(value, list):
            waiting += ((item, depth + 1) for item in value)


def load_config(path: Path) -> Config:
    """The validated configuration of a daemon; relative paths in it are relative to the file.

    Raises:
        ConfigError: unreadable, not YAML, unknown key, wrong type or value out of range; names each place.
    """
    document = load_yaml(path)
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: expected a mapping at the top, found {type(document).__name__}")
    try:
        config = Config.model_validate(document)
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe(error)}") from error
    return _resolve_paths(config, path.parent)


def describe(error: ValidationError) -> str:
    """Each complaint of pydantic on a line: where, what."""
    lines = [f"{'.'.join(str(part) for part in item['loc']) or '(top)'}: {item['msg']}" for item in error.errors()]
    return "; ".join(lines)


def _resolve_paths(config: Config, folder: Path) -> Config:
    """Relative paths are relative to the configuration file, not to wherever the daemon was started."""
    zenoh = config.zenoh
    if zenoh.file is not None:
        zenoh = zenoh.model_copy(update={"file": folder / zenoh.file})
    own = config.authority
    files = {"certificate": own.certificate, "private_key": own.private_key, "root_ca": own.root_ca}
    authority = own.model_copy(update={name: None if path is None else folder / path for name, path in files.items()})
    state = config.state.model_copy(update={"directory": folder / config.state.directory})
    pairs = tuple(_resolve_pair_paths(pair, folder) for pair in config.pairs)
    awaited = tuple(_resolve_pair_paths(pair, folder) for pair in config.awaited)
    return config.model_copy(
        update={"pairs": pairs, "awaited": awaited, "state": state, "zenoh": zenoh, "authority": authority}
    )


_P = TypeVar("_P", bound=OpenPairConfig)


def _resolve_pair_paths(pair: _P, folder: Path) -> _P:
    camera, depth = pair.camera, pair.calibration.depth
    if camera.mask is not None:
        camera = camera.model_copy(update={"mask": folder / camera.mask})
    if depth.model.endswith(".onnx"):
        depth = depth.model_copy(update={"model": str(folder / depth.model)})
    calibration = pair.calibration.model_copy(update={"depth": depth})
    return pair.model_copy(update={"camera": camera, "calibration": calibration})
