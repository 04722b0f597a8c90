"""The rig form of a configuration lists each sensor of a vehicle once; the long form of `pairs` follows from it. Links
are known rigid poses between two sensors of a kind.

A pair of camera C and LiDAR L is named `C-L`, or just `C` if the vehicle has one LiDAR. Its nominal calibration is
inverse(T_vehicle_camera) · T_vehicle_lidar if both poses are given; otherwise the pair is incomplete, as any pair
without a nominal calibration. On native keys a sensor's `frame_id` is its name unless another is given.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Self, TypeVar

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from coec.config.model import IDENTITY, MAX_NAME, ConfigModel, Name, describe
from coec.config.pair import OpenCameraConfig, OpenEgoConfig, OpenLidarConfig, Pose
from coec.config.stages import (
    CalibrationConfig,
    MonitorConfig,
    PairingConfig,
    PolicyConfig,
    TrackerConfig,
    WindowConfig,
)
from coec.errors import ConfigError


class LinkConfig(ConfigModel):
    """The known pose between two cameras, or between two LiDARs, for example on a stereo bar or a common mount."""

    camera_a: Name | None = Field(default=None, description="name of a camera")
    camera_b: Name | None = Field(default=None, description="name of another camera")
    lidar_a: Name | None = Field(default=None, description="or: name of a LiDAR")
    lidar_b: Name | None = Field(default=None, description="name of another LiDAR")
    T_a_b: Pose = Field(description="pose of b in the frame of a: maps b coordinates to a coordinates")
    sigma_deg: float = Field(gt=0, le=180, description="standard deviation about each axis, degrees")
    sigma_m: float = Field(gt=0, le=10, description="standard deviation along each axis, m")

    @property
    def ends(self) -> tuple[str, str]:
        """Names of a and b."""
        return self.camera_a or self.lidar_a or "", self.camera_b or self.lidar_b or ""

    @model_validator(mode="after")
    def _two_of_a_kind(self) -> LinkConfig:
        cameras, lidars = (self.camera_a, self.camera_b), (self.lidar_a, self.lidar_b)
        of_cameras = None not in cameras and lidars == (None, None)
        of_lidars = None not in lidars and cameras == (None, None)
        if not (of_cameras or of_lidars) or self.ends[0] == self.ends[1]:
            raise ValueError("a link is of two cameras (camera_a, camera_b) or of two LiDARs (lidar_a, lidar_b)")
        return self


MAX_SENSORS = 16
"""Most cameras of a vehicle, and most LiDARs."""

MAX_LINKS = 64

MIN_LIDAR_SHARE = 0.005
"""Least share of a LiDAR's directions that a camera must see. It stands for 500 of the 100,000 points of a sweep of 64
beams: with fewer points in view a window takes no frame pair (`window.min_points_in_view`)."""

MIN_CAMERA_SHARE = 0.1
"""Least share of the image that the LiDAR must cover: 1 is what a LiDAR that measures all around would cover. Less is a
strip at the edge of the image. There the lens model is worst and the vehicle itself is in the way, and a strip cannot
tell the three rotations apart."""

ALL = "all"

T = TypeVar("T")


class FieldOfView(ConfigModel):
    """Where a LiDAR measures, in its own frame: x ahead, y left, z up."""

    azimuth_deg: tuple[float, float] = Field(
        default=(-180.0, 180.0), description="[from, to], counter-clockwise from x, degrees"
    )
    elevation_deg: tuple[float, float] = Field(default=(-25.0, 15.0), description="[from, to], upwards, degrees")

    @model_validator(mode="after")
    def _from_to(self) -> Self:
        if not 0 < self.azimuth_deg[1] - self.azimuth_deg[0] <= 360 or abs(self.azimuth_deg[0]) > 360:
            raise ValueError("azimuth_deg is [from, to], counter-clockwise, at most 360 apart: [120, 240] is behind")
        if not -90 <= self.elevation_deg[0] < self.elevation_deg[1] <= 90:
            raise ValueError("elevation_deg is [from, to], between -90 and 90")
        return self


class RigCamera(OpenCameraConfig):
    """A camera of the vehicle."""

    name: Name = Field(description="name of the camera")
    T_vehicle_camera: Pose | None = Field(default=None, description="pose of the camera in the vehicle's frame")


class RigLidar(OpenLidarConfig):
    """A LiDAR of the vehicle."""

    name: Name = Field(description="name of the LiDAR")
    T_vehicle_lidar: Pose | None = Field(default=None, description="pose of the LiDAR in the vehicle's frame")
    field_of_view: FieldOfView = FieldOfView()


class RigEgo(OpenEgoConfig):
    """The ego-motion of the vehicle."""

    T_lidar_ego: None = Field(
        default=None, description="not given here: follows from `T_vehicle_ego` and the pose of each LiDAR"
    )
    T_vehicle_ego: Pose = Field(default=IDENTITY, description="pose of the ego-motion's frame in the vehicle's frame")


class RigStages(ConfigModel):
    """Everything that can be set for a pair except its sensors."""

    pairing: PairingConfig = PairingConfig()
    window: WindowConfig = WindowConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    monitor: MonitorConfig = MonitorConfig()
    policy: PolicyConfig = PolicyConfig()
    tracker: TrackerConfig = TrackerConfig()


class RigPair(RigStages):
    """A camera and a LiDAR that make a pair."""

    camera: Name = Field(description="name of the camera")
    lidar: Name = Field(description="name of the LiDAR")
    name: Name | None = Field(default=None, description="name of the pair; by default made from its sensors' names")


def _pair_list(value: Any) -> Any:
    if value == ALL:
        return None
    if isinstance(value, list | tuple):
        return value
    raise ValueError(f"give `{ALL}`, or a list of {{camera: NAME, lidar: NAME}}")


class RigConfig(ConfigModel):
    """The sensors of a vehicle."""

    cameras: tuple[RigCamera, ...] = Field(min_length=1, max_length=MAX_SENSORS, description="each listed once")
    lidars: tuple[RigLidar, ...] = Field(min_length=1, max_length=MAX_SENSORS, description="each listed once")
    ego: RigEgo | None = None
    pairs: Annotated[tuple[RigPair, ...] | None, BeforeValidator(_pair_list)] = Field(
        description="`all`: every camera and LiDAR that see something in common; or a list"
    )
    stages: RigStages = Field(default=RigStages(), description="settings of every pair that does not set its own")
    links: tuple[LinkConfig, ...] = Field(default=(), max_length=MAX_LINKS, description="as in the whole configuration")

    @model_validator(mode="after")
    def _unique_names(self) -> Self:
        for place, sensors in (("cameras", self.cameras), ("lidars", self.lidars)):
            names = [sensor.name for sensor in sensors]
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"{place}: {', '.join(twice)} is given twice")
        return self


def is_rig(document: Mapping[str, Any]) -> bool:
    """Whether a configuration, as it is written, is in the form that lists each sensor once."""
    return "cameras" in document or "lidars" in document or document.get("pairs") == ALL


def expand_rig(document: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of a rig, as it is written, in the long form: each pair with its streams.

    Raises:
        ConfigError: names each place.
    """
    own = {name: document[name] for name in RigConfig.model_fields if name in document}
    try:
        rig = RigConfig.model_validate(own)
    except ValidationError as error:
        names = {kind: _names(document.get(kind)) for kind in ("cameras", "lidars")}
        raise ConfigError(describe(error, names)) from error
    expansion = _PairExpansion(rig, native=document.get("middleware", "native") == "native")
    pairs = list(expansion)
    if not pairs:
        raise ConfigError(
            "pairs: with the poses that are given, no camera sees what a LiDAR sees: check T_vehicle_camera, "
            "T_vehicle_lidar and field_of_view, or list the pairs"
        )
    links = [link.model_dump(exclude_none=True) for link in rig.links]
    rest = {name: value for name, value in document.items() if name not in own}
    return {**rest, "pairs": pairs, "links": links, "left_out": expansion.left_out}


def _names(sensors: Any) -> list[str]:
    """Names of sensors as they are written, by index."""
    if not isinstance(sensors, list | tuple):
        return []
    names = [sensor.get("name") if isinstance(sensor, dict) else None for sensor in sensors[: 2 * MAX_SENSORS]]
    return [name if isinstance(name, str) and len(name) <= MAX_NAME else str(i) for i, name in enumerate(names)]


class _PairExpansion:
    """The pairs of a rig in their long form.

    Attributes:
        left_out: if `pairs` is `all`: names of the pairs that were not made, as their sensors see nothing in common.
    """

    def __init__(self, rig: RigConfig, *, native: bool) -> None:
        self._rig = rig
        self._native = native
        self._cameras = {camera.name: camera for camera in rig.cameras}
        self._lidars = {lidar.name: lidar for lidar in rig.lidars}
        self.left_out: list[str] = []

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """All of them.

        Raises:
            ConfigError: a listed sensor does not exist, or lacks a value that has no other source.
        """
        if self._rig.pairs is None:
            for camera in self._rig.cameras:
                for lidar in self._rig.lidars:
                    if _have_common_view(camera, lidar):
                        yield self._pair(camera, lidar, None)
                    else:
                        self.left_out.append(self._name(camera, lidar))
            return
        for index, pair in enumerate(self._rig.pairs):
            camera_of = _sensor_named(self._cameras, pair.camera, f"pairs.{index}.camera", "camera")
            yield self._pair(camera_of, _sensor_named(self._lidars, pair.lidar, f"pairs.{index}.lidar", "LiDAR"), pair)

    def _name(self, camera: RigCamera, lidar: RigLidar) -> str:
        return camera.name if len(self._lidars) == 1 else f"{camera.name}-{lidar.name}"

    def _pair(self, camera: RigCamera, lidar: RigLidar, written: RigPair | None) -> dict[str, Any]:
        if self._native:
            _require_calibration(camera, lidar)
        # On native keys each sensor's frames carry its own name, unless a `frame_id` is given.
        frames = {kind: {"frame_id": sensor.name} for kind, sensor in (("camera", camera), ("lidar", lidar))}
        frames = frames if self._native else {"camera": {}, "lidar": {}}
        own = {} if written is None else written.model_dump(exclude_unset=True, exclude={"camera", "lidar"})
        name = own.pop("name", None) or self._name(camera, lidar)
        if len(name) > MAX_NAME:
            raise ConfigError(
                f"pairs: {name} has more than {MAX_NAME} characters: list the pairs, and give it a `name`"
            )
        pair = {
            "name": name,
            "camera": frames["camera"] | camera.model_dump(exclude_unset=True, exclude={"T_vehicle_camera"}),
            "lidar": frames["lidar"]
            | lidar.model_dump(exclude_unset=True, exclude={"T_vehicle_lidar", "field_of_view"}),
            "T_camera_lidar": _nominal(camera, lidar),
            **_merged(self._rig.stages.model_dump(exclude_unset=True), own),
        }
        if self._rig.ego is not None:
            pair["ego"] = _ego(self._rig.ego, lidar)
        return pair


def _sensor_named(sensors: Mapping[str, T], name: str, where: str, kind: str) -> T:
    if name not in sensors:
        raise ConfigError(f"{where}: there is no {kind} {name}; there are {', '.join(sensors)}")
    return sensors[name]


def _require_calibration(camera: RigCamera, lidar: RigLidar) -> None:
    """Refuses sensors whose intrinsics or pose are missing: native frames do not tell them."""
    lacking = {
        f"cameras.{camera.name}.intrinsics": camera.intrinsics,
        f"cameras.{camera.name}.T_vehicle_camera": camera.T_vehicle_camera,
        f"lidars.{lidar.name}.T_vehicle_lidar": lidar.T_vehicle_lidar,
    }
    places = ", ".join(place for place, value in lacking.items() if value is None)
    if places:
        raise ConfigError(f"{places}: must be given where `middleware` is `native`, because nothing on the bus says it")


def _nominal(camera: RigCamera, lidar: RigLidar) -> Any:
    from coec.config import poses

    if camera.T_vehicle_camera is None or lidar.T_vehicle_lidar is None:
        return None
    return poses.relative(camera.T_vehicle_camera, lidar.T_vehicle_lidar)


def _ego(ego: RigEgo, lidar: RigLidar) -> dict[str, Any]:
    from coec.config import poses

    document = ego.model_dump(exclude_unset=True, exclude={"T_vehicle_ego", "T_lidar_ego"})
    if lidar.T_vehicle_lidar is not None:
        document["T_lidar_ego"] = poses.relative(lidar.T_vehicle_lidar, ego.T_vehicle_ego)
    return document


def _have_common_view(camera: RigCamera, lidar: RigLidar) -> bool:
    """Whether both see enough in common; True where that is not known yet.

    Raises:
        ConfigError: the model of the camera refuses its parameters.
    """
    from coec.config import poses

    nominal, intrinsics = _nominal(camera, lidar), camera.intrinsics
    if nominal is None or intrinsics is None:
        return True
    field = lidar.field_of_view
    camera_model = (intrinsics.model, intrinsics.parameters(), nominal)
    try:
        common = poses.common_view(*camera_model, field.azimuth_deg, field.elevation_deg)
    except ValueError as error:
        raise ConfigError(f"cameras.{camera.name}.intrinsics: {error}") from error
    return common.of_lidar >= MIN_LIDAR_SHARE and common.of_camera >= MIN_CAMERA_SHARE


def _merged(common: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Both mappings merged key by key; where both set a value, `own` wins."""
    merged = {**common, **own}
    for name in common.keys() & own.keys():
        if isinstance(common[name], dict) and isinstance(own[name], dict):
            merged[name] = _merged(common[name], own[name])
    return merged
