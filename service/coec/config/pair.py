"""One camera-LiDAR pair: its streams, the poses between them, and the stages of its calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, model_validator

from coec.config.base import ConfigModel, Matrix4x4, Name
from coec.config.decisions import MonitorConfig, PolicyConfig
from coec.config.stages import CalibrationConfig, PairingConfig, TrackerConfig, WindowConfig
from coec.config.streams import (
    AnyStreamConfig,
    CameraConfig,
    EgoConfig,
    KnownStreamConfig,
    LidarConfig,
    OpenCameraConfig,
    OpenEgoConfig,
    OpenLidarConfig,
)


class OpenPairConfig(ConfigModel):
    """One camera-LiDAR pair that may leave out what the service can read from ROS 2 topics: the frames of its sensors,
    the intrinsics (`CameraInfo`) and the poses between the sensors (`/tf_static`). `points: TEXT` is short for
    `lidar: {topic: TEXT}`."""

    name: Name = Field(description="name of the pair, part of its keys and file names")
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
    def streams(self) -> Mapping[str, AnyStreamConfig]:
        """Those that it has, by the names under which they are counted."""
        streams = {"camera": self.camera, "lidar": self.lidar, "ego": self.ego}
        return {name: stream for name, stream in streams.items() if stream is not None}

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
    T_camera_lidar: Matrix4x4 = Field(description="workshop calibration: LiDAR to camera")

    @property
    def streams(self) -> Mapping[str, KnownStreamConfig]:
        """Those that it has, by the names under which they are counted."""
        streams = {"camera": self.camera, "lidar": self.lidar, "ego": self.ego}
        return {name: stream for name, stream in streams.items() if stream is not None}
