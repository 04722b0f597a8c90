"""The index of a bag: one pass verifies the bag, and notes the place of each frame and the stamp of its header.

The stamp of the header is the sensor's time. A cloud without a stamp gets the time of its first point. The recorder's
time is not used.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from coec.adapters.ros import messages
from coec.adapters.ros.camera_info import CameraInfoContent, decode_info
from coec.adapters.ros.static_transforms import StaticTransforms, decode_static_transforms
from coec.calibration.types import Matrix4
from coec.errors import DecodeError, SourceError
from coec.schemas.ros_names import TF_STATIC
from coec.sources.bag.cloud_reading import CloudDecoder
from coec.sources.bag.storage import BagMessage, BagStorage

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
    infos: dict[str, CameraInfoContent] = field(default_factory=dict)
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
            self.infos[entry.topic] = self._decoded(entry, decode_info)
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
