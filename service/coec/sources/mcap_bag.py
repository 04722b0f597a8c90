"""MCAP as a source: a window that coec recorded, or any ROS 2 bag with a camera and a LiDAR.

A bag is gone through once, to verify it and to note where each message lies and what its header's stamp is; messages
are read again when it is their turn. The header stamp is the sensor's time; the recorder's is not looked at.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from coec.adapters.files.rig import camera_of, load_mask, rigid_matrix
from coec.adapters.mcap.files import Channel, McapDamaged, MessageReader, Schema, read_records
from coec.adapters.mcap.files import Message as McapMessage
from coec.adapters.mcap.windows import is_window, read_window
from coec.adapters.ros import cdr
from coec.calibration.types import CameraFrame, FramePair, Matrix4, Rig
from coec.config import CalibrationConfig, CameraIntrinsics, FilePath, LimitsConfig, Matrix4x4, describe, load_yaml
from coec.errors import ConfigError, DecodeError, SourceError
from coec.geometry import cameras
from coec.geometry.se3 import inverse, rotation_from_quaternion_xyzw, transform_from
from coec.sources.recording import (
    MOTION_REACH_NS,
    FramewiseRecording,
    Message,
    RecordedFrame,
    Recording,
    chosen_indices,
)
from coec.sources.spec import SourceSpec

IMAGE_TYPES = (cdr.COMPRESSED_IMAGE, cdr.IMAGE)
CLOUD_TYPES = (cdr.POINT_CLOUD,)
MOTION_TYPES = (cdr.ODOMETRY, cdr.TWIST)

_STORE = get_typestore(Stores.ROS2_HUMBLE)

_HEADER = {1: struct.Struct("<iI"), 0: struct.Struct(">iI")}
"""`std_msgs/Header.stamp` (sec, nanosec), with which every type above begins, by the byte order of the message."""

MAX_JOINT_M = 1e9
"""Of a static transform, per axis, metres: frames of maps may lie at the centre of the earth, 6.4e6 m away."""

_EGO, _LIDAR, _CAMERA = 0, 1, 2
"""Order of messages with equal stamps, as in `recording`."""


class RigFile(BaseModel):
    """`intrinsics=FILE`: the head of a `dataset.yaml`, for bags without camera info or without a transform."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    camera: CameraIntrinsics
    T_camera_lidar: Matrix4x4 | None = None
    mask: FilePath | None = None


def open_mcap(spec: SourceSpec) -> Recording:
    """`FILE.mcap[?camera=/TOPIC][&points=/TOPIC][&odometry=/TOPIC][&intrinsics=FILE or /TOPIC]`.

    Without a query, a recorded window is opened as such. In any other bag topics are found by their type where there is
    only one of it. Intrinsics come from the `CameraInfo` of the camera's frame (or of the topic named), or from a YAML
    file; the extrinsic from that file, else from `/tf_static`, over any number of joints. Where `/tf_static` does not
    lead to the frame of the odometry, its twist is taken as the LiDAR's own.

    Raises:
        UsageError: unknown query key.
        SourceError: not MCAP, cut off or damaged; no topic, or several, of a type; no intrinsics, no extrinsic.
        WindowError: a recorded window that is damaged.
    """
    query = spec.only("camera", "points", "odometry", "intrinsics")
    if not query and is_window(spec.path):
        return _window_recording(spec.path)
    index = _index(spec.path)
    camera_topic = index.topic(IMAGE_TYPES, query.get("camera"), "camera")
    lidar_topic = index.topic(CLOUD_TYPES, query.get("points"), "points")
    motion_topic = index.optional_topic(MOTION_TYPES, query.get("odometry"), "odometry")
    streams = {
        _CAMERA: index.streams[camera_topic].ordered(),
        _LIDAR: index.streams[lidar_topic].ordered(),
        _EGO: [] if motion_topic is None else index.streams[motion_topic].ordered(),
    }
    with spec.path.open("rb") as stream:
        reader = MessageReader(stream)
        firsts = {kind: _load(spec.path, reader, places[0]) for kind, places in streams.items() if places}
    rig = _rig(spec, index, query.get("intrinsics"), firsts)
    return BagRecording(f"{spec.path.name}{camera_topic}", rig, rig.T_camera_lidar_nominal, spec.path, streams)


def _window_recording(path: Path) -> FramewiseRecording:
    window, configuration = read_window(path)

    def frame_of(pair: FramePair) -> RecordedFrame:
        return RecordedFrame(pair.camera.stamp_ns, lambda: pair.camera, pair.lidar.stamp_ns, lambda: pair.lidar)

    return FramewiseRecording(
        window.window_id,
        window.rig,
        window.T_camera_lidar_start,
        tuple(frame_of(pair) for pair in window.pairs),
        tuple(pair.motion for pair in window.pairs if pair.motion is not None),
        configuration,
    )


@dataclass(frozen=True, slots=True, order=True)
class _Place:
    """Where a message lies, ordered by the stamp of its header."""

    stamp_ns: int
    at: int
    chunk_at: int | None = field(compare=False)
    length: int = field(compare=False)
    type_name: str = field(compare=False)


@dataclass(frozen=True, slots=True, eq=False)
class BagRecording:
    """A `Recording` whose streams have their own cadence.

    Attributes:
        path: the bag.
        streams: places of the messages by kind, ascending by stamp.
    """

    name: str
    rig: Rig
    T_camera_lidar_start: Matrix4
    path: Path
    streams: dict[int, list[_Place]]
    configuration: CalibrationConfig | None = None

    @property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames, ascending, nanoseconds."""
        return tuple(place.stamp_ns for place in self.streams[_CAMERA])

    def messages(self, cameras: Collection[int] | None = None) -> Iterator[Message]:
        """See `Recording.messages`. Of the sweeps, the nearest to each chosen camera frame is handed out."""
        chosen = [self.streams[_CAMERA][index] for index in chosen_indices(cameras, len(self.streams[_CAMERA]))]
        sweeps, motions = self.streams[_LIDAR], self.streams[_EGO]
        if cameras is not None:
            sweeps = sorted({min(sweeps, key=lambda place: abs(place.stamp_ns - c.stamp_ns)) for c in chosen})
            motions = [m for m in motions if any(abs(m.stamp_ns - c.stamp_ns) <= MOTION_REACH_NS for c in chosen)]
        queue = [
            (place.stamp_ns, kind, place)
            for kind, places in ((_EGO, motions), (_LIDAR, sweeps), (_CAMERA, chosen))
            for place in places
        ]
        with self.path.open("rb") as stream:
            reader = MessageReader(stream)
            for _, _, place in sorted(queue):
                yield _load(self.path, reader, place)


def _load(path: Path, reader: MessageReader, place: _Place) -> Message:
    try:
        data = reader.read(place.chunk_at, place.at, place.length)
        return cdr.decode(place.type_name, data, LimitsConfig())
    except McapDamaged as error:
        raise SourceError(f"{path}: {error}") from error
    except DecodeError as error:
        raise SourceError(f"{path}: the {place.type_name} of {place.stamp_ns} ns: {error}") from error


# --- what is in the bag ---------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Stream:
    type_name: str
    places: list[_Place] = field(default_factory=list)

    def ordered(self) -> list[_Place]:
        return sorted(self.places)


@dataclass(slots=True)
class _Index:
    """One pass over a bag: frames by topic, the first camera info of each topic, every static transform."""

    path: Path
    streams: dict[str, _Stream] = field(default_factory=dict)
    infos: dict[str, Any] = field(default_factory=dict)
    parents: dict[str, dict[str, Matrix4]] = field(default_factory=dict)

    def topic(self, types: tuple[str, ...], asked: str | None, key: str) -> str:
        """The topic of these types that was asked for, or the only one."""
        found = self.optional_topic(types, asked, key)
        if found is None:
            raise SourceError(f"{self.path} has no message of type {' or '.join(types)}")
        return found

    def optional_topic(self, types: tuple[str, ...], asked: str | None, key: str) -> str | None:
        """As `topic`, but None where there is none at all and none was asked for."""
        there = [topic for topic, stream in self.streams.items() if stream.type_name in types]
        if asked is not None:
            if asked not in there:
                raise SourceError(f"{self.path} has no topic {asked} for {key}; there: {', '.join(there) or 'none'}")
            return asked
        if len(there) > 1:
            raise SourceError(
                f"{self.path} has several topics for {key}, choose one with ?{key}=...: {', '.join(there)}"
            )
        return there[0] if there else None

    def transform(self, target: str, source: str) -> Matrix4 | None:
        """T_target_source (4, 4) along the static transforms, or None where they do not connect the two."""
        reached = {source: np.eye(4)}
        frontier = [source]
        while frontier and target not in reached:
            frame = frontier.pop(0)
            for neighbour, T_neighbour_frame in self.parents.get(frame, {}).items():
                if neighbour not in reached:
                    reached[neighbour] = T_neighbour_frame @ reached[frame]
                    frontier.append(neighbour)
        return reached.get(target)

    def take(self, channel: Channel, schema: Schema, message: McapMessage) -> None:
        """Notes a message."""
        name = schema.name
        if name in (*IMAGE_TYPES, *CLOUD_TYPES, *MOTION_TYPES):
            stream = self.streams.setdefault(channel.topic, _Stream(name))
            stamp_ns = _header_stamp_ns(message.data)
            if stamp_ns is None:
                raise SourceError(f"{self.path}: a message on {channel.topic} has no valid header")
            place = _Place(stamp_ns, message.at, message.chunk_at, len(message.data), name)
            stream.places.append(place)
        elif name == cdr.CAMERA_INFO and channel.topic not in self.infos:
            self.infos[channel.topic] = self._decoded(channel, name, message.data)
        elif name == cdr.TF and channel.topic == "/tf_static":
            for joint in self._decoded(channel, name, message.data).transforms:
                self._join(channel, joint)

    def _join(self, channel: Channel, joint: Any) -> None:
        rotation, translation = joint.transform.rotation, joint.transform.translation
        quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
        offset_m = np.array([translation.x, translation.y, translation.z])
        if not (np.abs(offset_m) <= MAX_JOINT_M).all():
            raise SourceError(f"{self.path}: a transform on {channel.topic} is not one: no finite place, or far away")
        try:
            T_parent_child = transform_from(rotation_from_quaternion_xyzw(quaternion), offset_m)
        except ValueError as error:
            raise SourceError(f"{self.path}: a transform on {channel.topic} is not one: {error}") from error
        parent, child = joint.header.frame_id.lstrip("/"), joint.child_frame_id.lstrip("/")
        self.parents.setdefault(child, {})[parent] = T_parent_child
        self.parents.setdefault(parent, {})[child] = inverse(T_parent_child)

    def _decoded(self, channel: Channel, type_name: str, data: bytes) -> Any:
        try:
            return _STORE.deserialize_cdr(data, type_name)
        except (SerdeError, ValueError, IndexError, struct.error) as error:
            raise SourceError(f"{self.path}: a message on {channel.topic} is not a {type_name}") from error


def _index(path: Path) -> _Index:
    index = _Index(path)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    try:
        with path.open("rb") as stream:
            for record in read_records(stream):
                match record:
                    case Schema():
                        schemas[record.schema_id] = record
                    case Channel():
                        channels[record.channel_id] = record
                    case McapMessage():
                        channel = channels.get(record.channel_id)
                        schema = None if channel is None else schemas.get(channel.schema_id)
                        if channel is not None and schema is not None and channel.message_encoding == "cdr":
                            index.take(channel, schema, record)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error
    except McapDamaged as error:
        raise SourceError(f"{path} is damaged: {error}. `mcap recover` saves what is whole") from error
    return index


def _header_stamp_ns(data: bytes) -> int | None:
    layout = _HEADER.get(data[1]) if len(data) >= 12 else None
    if layout is None:
        return None
    seconds, nanoseconds = layout.unpack_from(data, 4)
    return seconds * 1_000_000_000 + nanoseconds if seconds >= 0 and nanoseconds < 1_000_000_000 else None


# --- its rig --------------------------------------------------------------------------------------------------


def _rig(spec: SourceSpec, index: _Index, intrinsics: str | None, firsts: dict[int, Message]) -> Rig:
    camera_frame, lidar_frame = firsts[_CAMERA].frame_id.lstrip("/"), firsts[_LIDAR].frame_id.lstrip("/")
    mask = None
    T_camera_lidar = index.transform(camera_frame, lidar_frame)
    try:
        if intrinsics is None or intrinsics in index.infos:
            camera = _camera_of_info(_info(index, intrinsics, camera_frame))
        else:
            path = Path(intrinsics).expanduser()
            document = RigFile.model_validate(load_yaml(path))
            camera = camera_of(document.camera)
            if document.T_camera_lidar is not None:
                T_camera_lidar = rigid_matrix(document.T_camera_lidar, "T_camera_lidar")
            if document.mask is not None:
                mask = load_mask(path.parent / document.mask, camera)
    except ValidationError as error:
        raise SourceError(f"{intrinsics}: {describe(error)}") from error
    except (ConfigError, ValueError) as error:
        raise SourceError(f"intrinsics of {spec.path}: {error}") from error
    if T_camera_lidar is None:
        raise SourceError(
            f"{spec.path}: /tf_static does not connect {camera_frame!r} and {lidar_frame!r}; "
            "give ?intrinsics=FILE with `camera:` and `T_camera_lidar:` as in a dataset.yaml"
        )
    image = firsts[_CAMERA]
    if isinstance(image, CameraFrame) and (image.image.width, image.image.height) != (camera.width, camera.height):
        raise SourceError(
            f"{spec.path}: images are {image.image.width} x {image.image.height} px, "
            f"the intrinsics are for {camera.width} x {camera.height} px"
        )
    T_lidar_ego = index.transform(lidar_frame, firsts[_EGO].frame_id.lstrip("/")) if _EGO in firsts else None
    return Rig(
        pair=re.sub(r"[^A-Za-z0-9_.-]", "_", spec.path.stem)[:64],
        camera=camera,
        camera_frame=firsts[_CAMERA].frame_id,
        lidar_frame=firsts[_LIDAR].frame_id,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4) if T_lidar_ego is None else T_lidar_ego,
        mask=mask,
    )


def _info(index: _Index, asked: str | None, camera_frame: str) -> Any:
    """The camera info that was asked for, the one of the camera's frame, or the only one."""
    if asked is not None:
        return index.infos[asked]
    matching = [info for info in index.infos.values() if info.header.frame_id.lstrip("/") == camera_frame]
    candidates = matching or list(index.infos.values())
    if len(candidates) != 1:
        topics = ", ".join(index.infos) or "none"
        raise SourceError(
            f"{index.path}: {len(candidates)} camera infos fit; "
            f"name one with ?intrinsics=/TOPIC, or give ?intrinsics=FILE; there: {topics}"
        )
    return candidates[0]


def _camera_of_info(info: Any) -> cameras.Camera:
    """The camera of a `CameraInfo`, by the names in `cdr.DISTORTION` and ROS 1's `fisheye`.

    Raises:
        ValueError: another model, or too few parameters.
    """
    size = {"width": int(info.width), "height": int(info.height)}
    matrix = [float(v) for v in info.k]
    focal = {"fx": matrix[0], "fy": matrix[4], "cx": matrix[2], "cy": matrix[5]}
    d = [float(v) for v in info.d]
    model = {"fisheye": "equidistant"}.get(info.distortion_model, info.distortion_model)
    if model in ("", "plumb_bob", "rational_polynomial") and not any(d):
        return cameras.build("pinhole", **size, **focal)
    if model == "rational_polynomial" and not any(d[5:]):
        model = "plumb_bob"
    for name, (distortion, parameters) in cdr.DISTORTION.items():
        if distortion == model and parameters:
            values = [*d, 0.0][: len(parameters)] if model == "plumb_bob" else d[: len(parameters)]
            if len(values) < len(parameters):
                raise ValueError(f"{model} has the parameters {' '.join(parameters)}, the camera info only {len(d)}")
            return cameras.build(name, **size, **focal, **dict(zip(parameters, values, strict=True)))
    known = ", ".join(sorted({distortion for distortion, _ in cdr.DISTORTION.values()}))
    raise ValueError(f"distortion model {model!r} is not known ({known} are); give ?intrinsics=FILE")
