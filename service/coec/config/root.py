"""The whole configuration of a daemon, and what its parts must agree on."""

from __future__ import annotations

import hashlib
import json
from typing import Any, Literal

from pydantic import BaseModel, Field, model_validator

from coec.config.model import ConfigModel, KeyExpression, Name
from coec.config.pair import OpenPairConfig, PairConfig
from coec.config.rig import MAX_LINKS, MAX_SENSORS, LinkConfig
from coec.config.service import (
    AuthorityConfig,
    BudgetConfig,
    LidarEdgesConfig,
    LimitsConfig,
    LogConfig,
    MetricsConfig,
    RosConfig,
    SnippetsConfig,
    StateConfig,
    UplinkConfig,
    WorkerConfig,
    ZenohConfig,
)
from coec.schemas.keys import LAST, RIG, ros_name

MAX_PAIRS = 32


class Config(ConfigModel):
    """The one configuration file of a daemon."""

    vehicle: Name = Field(default="vehicle", description="name of the vehicle, unique, part of every key")
    prefix: KeyExpression = Field(default="coec", description="beginning of all keys")
    zenoh: ZenohConfig = ZenohConfig()
    middleware: Literal["native", "rmw_zenoh", "ros2dds"] = Field(
        default="native",
        description="what frames come on: native Zenoh keys, topics of ROS 2 nodes (rmw_zenoh) or a bridge (ros2dds)",
    )
    ros: RosConfig = RosConfig()
    authority: AuthorityConfig = AuthorityConfig()
    state: StateConfig = StateConfig()
    snippets: SnippetsConfig = SnippetsConfig()
    worker: WorkerConfig = WorkerConfig()
    budget: BudgetConfig = BudgetConfig()
    lidar_edges: LidarEdgesConfig = LidarEdgesConfig()
    limits: LimitsConfig = LimitsConfig()
    stale_after_s: float = Field(
        default=600.0, gt=0, description="age of the last completed check at which a pair is called stale, s"
    )
    log: LogConfig = LogConfig()
    metrics: MetricsConfig = MetricsConfig()
    uplink: UplinkConfig = UplinkConfig()
    pairs: tuple[PairConfig, ...] = Field(
        default=(), max_length=MAX_PAIRS, description="what is calibrated; each pair is a camera and a LiDAR"
    )
    awaited: tuple[OpenPairConfig, ...] = Field(
        default=(),
        max_length=MAX_PAIRS,
        description="entries of `pairs` that leave out what ROS 2 topics tell; each joins `pairs` once that is found",
    )
    links: tuple[LinkConfig, ...] = Field(
        default=(),
        max_length=MAX_LINKS,
        description="known poses between two cameras, or between two LiDARs",
    )
    left_out: tuple[str, ...] = Field(
        default=(),
        max_length=MAX_SENSORS**2,
        description="for information: pairs that `pairs: all` did not make, as their sensors see nothing in common",
    )

    @property
    def every_pair(self) -> tuple[OpenPairConfig, ...]:
        """The complete pairs, then the awaited ones."""
        return (*self.pairs, *self.awaited)

    @model_validator(mode="before")
    @classmethod
    def _separate_incomplete_pairs(cls, document: Any) -> Any:
        if not isinstance(document, dict) or document.get("middleware", "native") == "native":
            return document
        pairs, incomplete = document.get("pairs", ()), document.get("awaited", ())
        if not isinstance(pairs, list | tuple) or not isinstance(incomplete, list | tuple):
            return document
        open_pairs = [pair for pair in pairs if _is_incomplete(pair)]
        return {
            **document,
            "pairs": [pair for pair in pairs if pair not in open_pairs],
            "awaited": [*open_pairs, *incomplete],
        }

    @model_validator(mode="after")
    def _pair_count_in_range(self) -> Config:
        if not 0 < len(self.every_pair) <= MAX_PAIRS:
            raise ValueError(f"pairs: give 1 to {MAX_PAIRS}")
        if self.awaited and self.middleware == "native":
            raise ValueError("awaited: nothing on the bus says what a pair leaves out where `middleware` is `native`")
        return self

    @model_validator(mode="after")
    def _unique_pair_names(self) -> Config:
        names = [pair.name for pair in self.every_pair]
        if len(set(names)) != len(names):
            raise ValueError("pair names must be unique")
        for taken, whose in ((RIG, "all of them together are called"), (LAST, "their last words are kept below")):
            if taken in names:
                raise ValueError(f"pairs: {whose} `{taken}`: give the pair of this name another one")
        return self

    @model_validator(mode="after")
    def _consistent_sensor_names(self) -> Config:
        for kind in ("camera", "lidar"):
            locations: dict[str, str] = {}
            for sensor in (pair.streams[kind] for pair in self.every_pair):
                name = getattr(sensor, "name", None)
                if name is not None and locations.setdefault(name, sensor.place) != sensor.place:
                    raise ValueError(f"pairs: {kind} {name} cannot be on {locations[name]} and on {sensor.place}")
            for index, link in enumerate(self.links):
                ends = [end for end in (getattr(link, f"{kind}_a"), getattr(link, f"{kind}_b")) if end is not None]
                absent = [end for end in ends if end not in locations]
                if absent:
                    known = ", ".join(locations) or "none has a `name`"
                    raise ValueError(f"links.{index}: no pair has a {kind} of the name {absent[0]}; there are: {known}")
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
    def _ros_output_possible(self) -> Config:
        if not self.ros.publish:
            return self
        if self.middleware == "native":
            raise ValueError(
                "ros.publish: nothing is published to ROS on native keys: set `middleware` to `rmw_zenoh` or `ros2dds`"
            )
        tokens = [ros_name(pair.name) for pair in self.every_pair]
        if len(set(tokens)) != len(tokens):
            raise ValueError(
                "ros.publish: names of pairs must differ in letters, digits or underscores: others become _"
            )
        return self


def _is_incomplete(pair: Any) -> bool:
    """Whether a pair, as it is written, leaves out something that ROS 2 topics tell."""
    if not isinstance(pair, dict):
        return False
    lidar, ego = pair.get("lidar", pair.get("points")), pair.get("ego")
    locations = [(pair, "T_camera_lidar"), (pair.get("camera"), "intrinsics"), (pair.get("camera"), "frame_id")]
    locations += [(lidar, "frame_id"), *([] if ego is None else [(ego, "T_lidar_ego")])]
    return any(isinstance(part, str) or (isinstance(part, dict) and part.get(name) is None) for part, name in locations)


def config_hash(*parts: BaseModel | str) -> str:
    """First 16 hexadecimal digits of the sha256 over the canonical JSON of the parts."""
    canonical = [part if isinstance(part, str) else part.model_dump(mode="json") for part in parts]
    text = json.dumps(canonical, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
