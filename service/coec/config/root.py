"""The whole configuration of a daemon, what its parts must agree on, and its YAML file. Size, depth and number of
values are bounded before anything is built; error messages name the key that is wrong.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from coec.config import service
from coec.config.model import ConfigModel, KeyExpression, Name, describe
from coec.config.pair import OpenPairConfig, PairConfig
from coec.config.rig import MAX_LINKS, MAX_SENSORS, LinkConfig, expand_rig, is_rig
from coec.errors import ConfigError, cannot_read
from coec.schemas.keys import LAST, RIG, ros_name

MAX_PAIRS = 32


class Config(ConfigModel):
    """The one configuration file of a daemon."""

    vehicle: Name = Field(default="vehicle", description="name of the vehicle, unique, part of every key")
    prefix: KeyExpression = Field(default="coec", description="beginning of all keys")
    zenoh: service.ZenohConfig = service.ZenohConfig()
    middleware: Literal["native", "rmw_zenoh", "ros2dds"] = Field(
        default="native",
        description="what frames come on: native Zenoh keys, topics of ROS 2 nodes (rmw_zenoh) or a bridge (ros2dds)",
    )
    ros: service.RosConfig = service.RosConfig()
    authority: service.AuthorityConfig = service.AuthorityConfig()
    state: service.StateConfig = service.StateConfig()
    snippets: service.SnippetsConfig = service.SnippetsConfig()
    worker: service.WorkerConfig = service.WorkerConfig()
    budget: service.BudgetConfig = service.BudgetConfig()
    lidar_edges: service.LidarEdgesConfig = service.LidarEdgesConfig()
    limits: service.LimitsConfig = service.LimitsConfig()
    stale_after_s: float = Field(
        default=600.0, gt=0, description="age of the last completed check at which a pair is called stale, s"
    )
    log: service.LogConfig = service.LogConfig()
    metrics: service.MetricsConfig = service.MetricsConfig()
    uplink: service.UplinkConfig = service.UplinkConfig()
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
    pose = "T_lidar_camera" if "T_lidar_camera" in pair else "T_camera_lidar"
    locations = [(pair, pose), (pair.get("camera"), "intrinsics"), (pair.get("camera"), "frame_id")]
    locations += [(lidar, "frame_id"), *([] if ego is None else [(ego, "T_lidar_ego")])]
    return any(isinstance(part, str) or (isinstance(part, dict) and part.get(name) is None) for part, name in locations)


def config_hash(*parts: BaseModel | str) -> str:
    """First 16 hexadecimal digits of the sha256 over the canonical JSON of the parts."""
    canonical = [part if isinstance(part, str) else part.model_dump(mode="json") for part in parts]
    text = json.dumps(canonical, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


MAX_YAML_BYTES = 2**20
"""Largest YAML file: enough for the 10,000 frames of a manifest, and for far more than the allowed pairs. A file of
this size with few values is read in 1 s (one core at 3 GHz)."""

MAX_YAML_DEPTH = 32
"""Deepest nesting; no file of coec is nested deeper than 6."""

MAX_YAML_VALUES = 100_000
"""Most values of a file, keys included; each takes 35 µs to read. Enough for a manifest of 5,200 frames with a velocity
each, or of 14,000 without."""

MERGE = "tag:yaml.org,2002:merge"


def load_yaml(path: Path, *, first: bool = False) -> Any:
    """The document of a YAML 1.2 file; with `first`, of several the first, as `ros2 topic echo` writes messages.

    Raises:
        ConfigError: the file cannot be read or is not YAML.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_YAML_BYTES + 1)
    except OSError as error:
        raise ConfigError(cannot_read(path, error)) from error
    if not data.strip():
        raise ConfigError(f"{path} is empty")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        detail = f"byte {error.start} is not UTF-8 text"
        raise ConfigError(f"{path} is not valid YAML: {detail}; is it the right file?") from error
    if first:
        head, *others = re.split(r"(?m)^---[ \t]*$", text)
        is_document = any(line.strip() and line[0] not in "%#" for line in head.splitlines())
        text = head if is_document or not others else f"{head}---{others[0]}"
    try:
        return parse_yaml(text)
    except ConfigError as error:
        raise ConfigError(f"{path} is not valid YAML: {error}") from error


def parse_yaml(text: str) -> Any:
    """The document of a YAML 1.2 text.

    Raises:
        ConfigError: the text is not YAML, or exceeds one of the limits above.
    """
    if len(text) > MAX_YAML_BYTES:
        raise ConfigError(f"it has more than {MAX_YAML_BYTES} bytes")
    reader = YAML(typ="safe", pure=True)
    reader.max_depth = MAX_YAML_DEPTH
    reader.Composer = _BoundedComposer
    reader.Constructor = _Constructor
    try:
        document = reader.load(text)
    except ConfigError:
        raise
    except MarkedYAMLError as error:
        raise ConfigError(_error_with_position(error)) from error
    except YAMLError as error:
        raise ConfigError(" ".join(str(error).split())) from error
    except Exception as error:  # constructors of numbers, dates and the like raise whatever Python's own raise
        raise ConfigError(f"a value in it is invalid: {type(error).__name__}") from error
    _check_extent(document)
    return document


def _error_with_position(error: MarkedYAMLError) -> str:
    """One line that says what is wrong and where."""
    mark = error.problem_mark
    where = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
    return " ".join(f"{where}{error.problem or error.context or 'no YAML'}".split())


class _BoundedComposer(Composer):
    """Refuses a document while reading it, as soon as it has too many values. It also refuses merge keys: YAML 1.2 does
    not have them, and they would copy values over and over."""

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


class _Constructor(SafeConstructor):
    """Also knows the matrices of OpenCV's FileStorage, which are mappings."""


_Constructor.add_constructor("tag:yaml.org,2002:opencv-matrix", SafeConstructor.construct_yaml_map)


def _check_extent(document: object) -> None:
    """Checks depth and number of values again with all aliases followed, as a validator would: with aliases a short
    text can make a huge, even endless document."""
    stack, values = [(document, 0)], 0
    while stack:
        value, depth = stack.pop()
        values += 1
        if depth > MAX_YAML_DEPTH or values > MAX_YAML_VALUES:
            raise ConfigError(f"it is nested deeper than {MAX_YAML_DEPTH}, or has more than {MAX_YAML_VALUES} values")
        if isinstance(value, dict):
            stack += ((item, depth + 1) for item in value.values())
        elif isinstance(value, list):
            stack += ((item, depth + 1) for item in value)


def load_config(path: Path) -> Config:
    """The validated configuration of a daemon; relative paths in it are relative to the file.

    Raises:
        ConfigError: unreadable, not YAML, unknown key, wrong type or value out of range; names each place.
    """
    document = load_yaml(path)
    try:
        return _resolve_paths(config_of(document), path.parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def config_of(document: Any) -> Config:
    """The configuration of a document, which may be in the form that lists each sensor once (see `config.rig`).

    Raises:
        ConfigError: no mapping, unknown key, wrong type or value out of range; names each place.
    """
    if not isinstance(document, dict):
        raise ConfigError(f"expected a mapping at the top, found {type(document).__name__}")
    if is_rig(document):
        document = expand_rig(document)
    try:
        return Config.model_validate(document)
    except ValidationError as error:
        raise ConfigError(describe(error)) from error


def _resolve_paths(config: Config, folder: Path) -> Config:
    """Relative paths are relative to the configuration file, not to wherever the daemon was started."""
    zenoh = config.zenoh
    if zenoh.file is not None:
        zenoh = zenoh.model_copy(update={"file": folder / zenoh.file})
    files = {name: getattr(config.authority, name) for name in ("certificate", "private_key", "root_ca")}
    authority = config.authority.model_copy(
        update={name: folder / path for name, path in files.items() if path is not None}
    )
    state = config.state.model_copy(update={"directory": folder / config.state.directory})
    pairs = tuple(_resolve_pair_paths(pair, folder) for pair in config.pairs)
    incomplete = tuple(_resolve_pair_paths(pair, folder) for pair in config.awaited)
    return config.model_copy(
        update={"pairs": pairs, "awaited": incomplete, "state": state, "zenoh": zenoh, "authority": authority}
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
