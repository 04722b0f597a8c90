"""The index of a bag: one pass verifies the bag and notes the location of each frame and the stamp of its header; the
rig of a pair, the topic of the vehicle's motion, and how clouds are decoded follow from it and from the query.

The stamp of the header is the sensor's time. A cloud without a stamp gets the time of its first point. The recorder's
time is not used.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, Matrix4, Rig
from coec.config import CameraIntrinsics, FilePath, LimitsConfig, Matrix4x4, PointTimeConfig, describe
from coec.config.pose_forms import with_direction
from coec.errors import ConfigError, DecodeError, SourceError, UsageError
from coec.io.intrinsics_files import load_camera_document, with_camera
from coec.io.recordings.bag_storage import BagMessage, BagReader, BagStorage
from coec.io.rig_files import camera_of, load_mask, rigid_matrix
from coec.io.ros import camera_info, message_decoding, messages
from coec.io.ros.transforms import MovingFrame, StaticTransforms, bare, decode_static_transforms, frames_in
from coec.io.user_files import expand_home
from coec.schemas.keys import TF_STATIC


@dataclass(frozen=True, slots=True)
class CloudDecoder:
    """How the clouds of a bag are read.

    Attributes:
        point_time: how points are timed; None: the messages tell.
        source: number of the LiDAR to choose from clouds of several LiDARs; None: all points.
    """

    point_time: PointTimeConfig | None = None
    source: int | None = None

    @classmethod
    def from_query(cls, time: str | None, source: str | None) -> CloudDecoder:
        """From the values of a query: `time` is `FIELD,UNIT[,BASE]`, `source` a whole number.

        Raises:
            UsageError: a value does not fit this form.
        """
        names = ("field", "unit", "base")
        try:
            timed = None if time is None else dict(zip(names, time.split(",", 2), strict=False))
            point_time = None if timed is None else PointTimeConfig.model_validate(timed)
        except ValidationError as error:
            raise UsageError(f"time={time}: {describe(error)}; for example time=timestamp,s,clock") from error
        try:
            return cls(point_time, None if source is None else int(source))
        except ValueError:
            raise UsageError(f"lidar_source={source}: it is a whole number, as in the points' field") from None

    def decode(self, type_name: str, data: bytes) -> CameraFrame | LidarFrame | EgoMotion:
        """The frame in a message of this type.

        Raises:
            DecodeError: the message holds no frame.
        """
        return message_decoding.decode(type_name, data, LimitsConfig(), point_time=self.point_time, source=self.source)


IMAGE_TYPES = (messages.COMPRESSED_IMAGE, messages.IMAGE)
CLOUD_TYPES = (messages.POINT_CLOUD,)
VELOCITY_TYPES = (messages.ODOMETRY, messages.TWIST, messages.TWIST_WITH_COVARIANCE)
ROTATION_TYPES = (messages.IMU,)

T = TypeVar("T")

_HEADER = {1: struct.Struct("<iI"), 0: struct.Struct(">iI")}
"""`std_msgs/Header.stamp` (sec, nanosec) by the byte order of the message. Every type above begins with it."""


@dataclass(frozen=True, slots=True, order=True)
class MessageLocation:
    """Where a message lies. Places are ordered by the stamp of the header; equal stamps by the order in the bag."""

    stamp_ns: int
    at: tuple[int, ...]
    type_name: str = field(compare=False)


@dataclass(slots=True)
class TopicStream:
    """The frames of a topic."""

    type_name: str
    locations: list[MessageLocation] = field(default_factory=list)

    def ordered(self) -> list[MessageLocation]:
        """The places in the order of their stamps."""
        return sorted(self.locations)


@dataclass(slots=True)
class BagIndex:
    """One pass over a bag.

    Attributes:
        clouds: how clouds are read.
        streams: frames by topic.
        infos: the first camera info of each topic.
        transforms: all static transforms.
        transforms_at: places of the messages of all other transforms, by topic, in the order in the bag.
    """

    path: Path
    clouds: CloudDecoder
    streams: dict[str, TopicStream] = field(default_factory=dict)
    infos: dict[str, camera_info.CameraInfoContent] = field(default_factory=dict)
    transforms: StaticTransforms = field(default_factory=StaticTransforms)
    transforms_at: dict[str, list[tuple[int, ...]]] = field(default_factory=dict)

    def topic(self, types: tuple[str, ...], requested: str | None, key: str) -> str:
        """The topic of these types that was asked for, else the only one.

        Raises:
            SourceError: there is no such topic, or there are several and none was asked for.
        """
        topic = self.optional_topic(types, requested, key)
        if topic is None:
            raise SourceError(f"{self.path} has no message of type {' or '.join(types)}")
        return topic

    def optional_topic(self, types: tuple[str, ...], requested: str | None, key: str) -> str | None:
        """As `topic`, but None if the bag has none and none was asked for."""
        there = [topic for topic, stream in self.streams.items() if stream.type_name in types]
        if requested is not None:
            if requested not in there:
                raise SourceError(
                    f"{self.path} has no topic {requested} for {key}; there: {', '.join(there) or 'none'}"
                )
            return requested
        if len(there) > 1:
            candidates = ", ".join(
                f"{topic} ({self.streams[topic].type_name}, {len(self.streams[topic].locations)} messages)"
                for topic in there
            )
            raise SourceError(f"{self.path} has several topics for {key}, choose one with ?{key}=...: {candidates}")
        return there[0] if there else None

    def transform(self, target: str, source: str) -> Matrix4 | None:
        """T_target_source (4, 4) along the static transforms; None if they do not connect the two frames.

        Raises:
            SourceError: they connect the frames in ways that contradict each other.
        """
        doubts = self.transforms.doubts(target, source)
        if doubts:
            raise SourceError(f"{self.path}: /tf_static is no tree: {'; '.join(doubts)}")
        return self.transforms.transform(target, source)

    def add(self, entry: BagMessage) -> None:
        """Notes a message.

        Raises:
            SourceError: the message is not what its topic says.
        """
        name = entry.type_name
        if name in (*IMAGE_TYPES, *CLOUD_TYPES, *VELOCITY_TYPES, *ROTATION_TYPES):
            stream = self.streams.setdefault(entry.topic, TopicStream(name))
            stamp_ns = _header_stamp_ns(entry.data)
            if stamp_ns is None:
                raise SourceError(f"{self.path}: a message on {entry.topic} has no valid header")
            if stamp_ns == 0 and name in CLOUD_TYPES:
                stamp_ns = self._stamp_of_points(entry)
            stream.locations.append(MessageLocation(stamp_ns, entry.place, name))
        elif name == messages.CAMERA_INFO and entry.topic not in self.infos:
            self.infos[entry.topic] = self._decoded(entry, camera_info.decode_info)
        elif name == messages.TF and entry.topic == TF_STATIC:
            self._decoded(entry, lambda data: self.transforms.add(decode_static_transforms(data)))
        elif name == messages.TF:
            self.transforms_at.setdefault(entry.topic, []).append(entry.place)

    def _stamp_of_points(self, entry: BagMessage) -> int:
        """Stamp of a cloud without one, from its points; 0 if they give none. If the cloud cannot be decoded, that is
        reported when it is used."""
        try:
            return self.clouds.decode(entry.type_name, entry.data).stamp_ns
        except DecodeError:
            return 0

    def _decoded(self, entry: BagMessage, decode: Callable[[bytes], T]) -> T:
        try:
            return decode(entry.data)
        except DecodeError as error:
            raise SourceError(f"{self.path}: a {entry.type_name} on {entry.topic} is refused: {error}") from error


def build_index(storage: BagStorage, clouds: CloudDecoder) -> BagIndex:
    """Makes the index of a bag whose clouds are read by `clouds`.

    Raises:
        SourceError: a file is absent, cut off or damaged, or a message is not what its topic says.
    """
    index = BagIndex(storage.path, clouds)
    for entry in storage.entries():
        index.add(entry)
    return index


def _header_stamp_ns(data: bytes) -> int | None:
    layout = _HEADER.get(data[1]) if len(data) >= 12 else None
    if layout is None:
        return None
    seconds, nanoseconds = layout.unpack_from(data, 4)
    return seconds * 1_000_000_000 + nanoseconds if seconds >= 0 and nanoseconds < 1_000_000_000 else None


class IntrinsicsFile(BaseModel):
    """`intrinsics=FILE`: the head of a `dataset.yaml`, for bags without camera info or without a transform."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    camera: CameraIntrinsics
    T_camera_lidar: Matrix4x4 | None = None
    mask: FilePath | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_direction(cls, document: Any) -> Any:
        return with_direction(document)


def rig_of_bag(
    index: BagIndex,
    intrinsics: str | None,
    image_topic: str,
    image: CameraFrame,
    lidar_frame_id: str,
    motion: EgoMotion | None,
) -> Rig:
    """The rig of a pair. Intrinsics come from the `CameraInfo` of the topic `intrinsics`, else beside the images, else
    of the camera's frame; or from the YAML file `intrinsics`. The extrinsic comes from that file, else from
    `/tf_static`.

    Raises:
        SourceError: there are no intrinsics, several, or those of another image size; or there is no extrinsic.
    """
    camera_frame, lidar_frame = bare(image.frame_id), bare(lidar_frame_id)
    mask = None
    T_camera_lidar = index.transform(camera_frame, lidar_frame)
    try:
        if intrinsics is None or intrinsics in index.infos:
            info = _info(index, intrinsics, camera_frame, image_topic)
            camera = camera_of(_lens(index, info, image_topic).intrinsics)
        else:
            path = expand_home(intrinsics)
            content, name = load_camera_document(path)
            size, rectified = (image.image.width, image.image.height), camera_info.is_rectified(image_topic)
            document = IntrinsicsFile.model_validate(with_camera(content, path, name, rectified=rectified, size=size))
            camera = camera_of(document.camera)
            if document.T_camera_lidar is not None:
                T_camera_lidar = rigid_matrix(document.T_camera_lidar, "T_camera_lidar")
            if document.mask is not None:
                mask = load_mask(path.parent / document.mask, camera)
    except ValidationError as error:
        raise SourceError(f"{intrinsics}: {describe(error)}") from error
    except (ConfigError, ValueError) as error:
        raise SourceError(f"intrinsics of {index.path}: {error}") from error
    if T_camera_lidar is None:
        raise SourceError(
            f"{index.path}: /tf_static does not connect {camera_frame!r} and {lidar_frame!r}; "
            "give ?intrinsics=FILE with `camera:` (which may name a camera_info.yaml) and `T_camera_lidar:` as in a "
            "dataset.yaml"
        )
    if (image.image.width, image.image.height) != (camera.width, camera.height):
        raise SourceError(
            f"{index.path}: images are {image.image.width} x {image.image.height} px, "
            f"the intrinsics are for {camera.width} x {camera.height} px"
        )
    T_lidar_ego = index.transform(lidar_frame, motion.frame_id) if motion else None
    return Rig(
        pair=re.sub(r"[^A-Za-z0-9_.-]", "_", index.path.stem)[:64],
        camera=camera,
        camera_frame=image.frame_id,
        lidar_frame=lidar_frame_id,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4) if T_lidar_ego is None else T_lidar_ego,
        mask=mask,
    )


def _lens(index: BagIndex, info: camera_info.CameraInfoContent, image_topic: str) -> camera_info.CameraInfoIntrinsics:
    try:
        return camera_info.intrinsics_of_info(info, rectified=camera_info.is_rectified(image_topic))
    except SourceError as error:
        raise SourceError(f"the camera info of {index.path}: {error}; give ?intrinsics=FILE") from error


def _info(index: BagIndex, requested: str | None, camera_frame: str, image_topic: str) -> camera_info.CameraInfoContent:
    """The camera info that was asked for, else the one beside the images, of the camera's frame, or the only one."""
    if requested is not None:
        return index.infos[requested]
    of_images = index.infos.get(camera_info.info_topic(image_topic))
    if of_images is not None:
        return of_images
    matching = [info for info in index.infos.values() if bare(info.frame_id) == camera_frame]
    candidates = matching or list(index.infos.values())
    if len(candidates) != 1:
        topics = ", ".join(index.infos) or "none"
        raise SourceError(
            f"{index.path}: {len(candidates)} camera infos fit; "
            f"name one with ?intrinsics=/TOPIC, or give ?intrinsics=FILE; there: {topics}"
        )
    return candidates[0]


VEHICLE: Final = ("odom", "base_link")
"""The frame in which a vehicle moves and the vehicle's own frame, as REP 105 names them."""

_LISTED: Final = 12
"""How many joints an error lists."""


def motion_topic(index: BagIndex, reader: BagReader, frames: tuple[str, str], requested: str | None) -> str | None:
    """The topic that was asked for; else the only one of velocities, else one of transforms of the vehicle (`frames`:
    parent, child), else the only one of turn rates; None if there is none.

    Raises:
        SourceError: there is no topic as asked for, or there are several of the best kind.
    """
    if requested in index.transforms_at:
        return requested
    if requested is not None:
        return index.optional_topic((*VELOCITY_TYPES, *ROTATION_TYPES), requested, "odometry")
    selected = index.optional_topic(VELOCITY_TYPES, None, "odometry")
    if selected is None:
        # Most bags have /tf, and in most of them the moving transforms are joints of a robot.
        selected = next(
            (topic for topic in sorted(index.transforms_at) if _motions(index, reader, topic, frames)), None
        )
    return selected or index.optional_topic(ROTATION_TYPES, None, "odometry")


def motions_of_transforms(
    index: BagIndex, reader: BagReader, topic: str, frames: tuple[str, str]
) -> tuple[EgoMotion, ...]:
    """The motion of the vehicle in the transforms of a topic, in the order of their stamps.

    Raises:
        SourceError: the transforms do not have the vehicle's frames; lists those that they have.
    """
    motions = _motions(index, reader, topic, frames)
    if not motions:
        there = sorted(_joints(index, reader, topic))
        joints_text = ", ".join(f"{parent},{child}" for parent, child in there[:_LISTED])
        more = ", ..." if len(there) > _LISTED else ""
        raise SourceError(
            f"{index.path}: {topic} does not say how {frames[1]!a} moves in {frames[0]!a}; name the frames with "
            f"?moving=PARENT,CHILD; there: {joints_text or 'none'}{more}"
        )
    return tuple(sorted(motions, key=lambda motion: motion.stamp_ns))


def _motions(index: BagIndex, reader: BagReader, topic: str, frames: tuple[str, str]) -> list[EgoMotion]:
    moving = MovingFrame(*frames)
    try:
        motions = [moving.motion(data) for data in _messages(index, reader, topic)]
    except DecodeError as error:
        raise SourceError(f"{index.path}: a message on {topic} is refused: {error}") from error
    return [motion for motion in motions if motion is not None]


def _joints(index: BagIndex, reader: BagReader, topic: str) -> set[tuple[str, str]]:
    return {joint for data in _messages(index, reader, topic) for joint in frames_in(data)}


def _messages(index: BagIndex, reader: BagReader, topic: str) -> Iterable[bytes]:
    return (reader.read(place) for place in index.transforms_at[topic])
