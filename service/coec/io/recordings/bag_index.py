"""The index of a bag: one pass verifies the bag and notes the location of each frame and the stamp of its header; the
rig of a pair, the topic of the vehicle's motion, and how clouds are decoded follow from it and from the query.

The stamp of the header is the sensor's time. A cloud without a stamp gets the time of its first point. The recorder's
time is not used.
"""

from __future__ import annotations

import struct
import sys
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import ValidationError

from coec.calibration.types import EgoMotion, Frame, Matrix4, Recognition
from coec.config import LimitsConfig, PointTimeConfig, describe
from coec.errors import DecodeError, SourceError, UsageError
from coec.io.recordings.bag_storage import MAX_MESSAGE_BYTES, BagMessage, BagReader, BagStorage
from coec.io.recordings.recording_source import CLOUD, IMAGE, MOTION, RECORD, DamagedFrames
from coec.io.ros import camera_info, message_decoding, messages, packed_clouds, packet_streams, point_clouds
from coec.io.ros import transforms as ros_transforms
from coec.io.ros.packet_streams import MAX_DESCRIPTION_BYTES, PacketStream, PacketSweep
from coec.io.user_files import expand_home
from coec.io.video import VideoTrack, codec_of
from coec.schemas.keys import TF_STATIC

LIMITS: Final = LimitsConfig(max_message_bytes=MAX_MESSAGE_BYTES)
"""A file holds larger messages than the bus lets through: raw images of 12 megapixels have 37 MB."""


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

    def decode(self, type_name: str, data: bytes) -> Frame:
        """The frame in a message of this type.

        Raises:
            DecodeError: the message holds no frame.
        """
        return message_decoding.decode(type_name, data, LIMITS, point_time=self.point_time, source=self.source)

    def load(self, reader: BagReader, place: MessageLocation) -> Frame:
        """The frame at a place.

        Raises:
            DecodeError: the messages there hold no frame.
            SourceError: the file is no longer what it was.
        """
        if place.packets is not None:
            return place.packets.load(reader)
        return self.decode(place.type_name, reader(place.at))


VIDEO_TYPES = (messages.FFMPEG_PACKET, messages.COMPRESSED_VIDEO)
IMAGE_TYPES = (messages.COMPRESSED_IMAGE, messages.IMAGE, *VIDEO_TYPES)
POINT_TYPES = (messages.POINT_CLOUD, *point_clouds.TYPES)
CLOUD_TYPES = (*POINT_TYPES, *packed_clouds.TYPES, *packet_streams.TYPES)
VELOCITY_TYPES = (messages.ODOMETRY, messages.TWIST, messages.TWIST_WITH_COVARIANCE)
ROTATION_TYPES = (messages.IMU,)

_USED: Final = (*IMAGE_TYPES, *CLOUD_TYPES, *VELOCITY_TYPES, *ROTATION_TYPES, messages.CAMERA_INFO, messages.TF)
_KINDS: Final = {IMAGE: IMAGE_TYPES, CLOUD: CLOUD_TYPES, MOTION: (*VELOCITY_TYPES, *ROTATION_TYPES)}

MAX_TF_MESSAGES: Final = 10_000
"""Most messages of transforms of a topic that are looked at for constant ones."""

FEW: Final = 10
"""Messages of a topic from which on one that is unlike all others is a damaged one."""

STRAY_S: Final = 10.0
"""Stamps are farther from the times of receipt than those of other messages only if they are damaged, s."""

MAX_FORMAT: Final = 40
"""Most characters of the format of a video in a message."""

UNMOVED: Final = 1e-6
"""Entries of a pose that change by less are constant."""

_HEADER = {1: struct.Struct("<iI"), 0: struct.Struct(">iI")}
"""`std_msgs/Header.stamp` (sec, nanosec) by the byte order of the message. Every type above begins with it, apart from
those of packets."""


@dataclass(frozen=True, slots=True, order=True)
class MessageLocation:
    """Where a message lies, and the frame that its header names. Places are ordered by the stamp of the header; equal
    stamps by the order in the bag. Of a sweep in packets, `at` is the first of its messages."""

    stamp_ns: int
    at: tuple[int, ...]
    type_name: str = field(compare=False)
    frame_id: str = field(default="", compare=False)
    packets: PacketSweep | None = field(default=None, compare=False)


@dataclass(slots=True)
class TopicStream:
    """The frames of a topic.

    Attributes:
        videos: of a topic of video, the packets by the frame that they name; `locations` has those of pictures.
        lags_s: seconds from the stamp of each message until the recorder received it.
        notes: what to tell of packets, and of clouds.
        empty: number of clouds without a point, which are left out.
    """

    type_name: str
    locations: list[MessageLocation] = field(default_factory=list)
    videos: dict[str, VideoTrack] = field(default_factory=dict)
    lags_s: array[float] = field(default_factory=lambda: array("d"))
    notes: tuple[Recognition, ...] = ()
    empty: int = 0

    def ordered(self) -> list[MessageLocation]:
        """The places in the order of their stamps."""
        return sorted(self.locations)

    @property
    def frames(self) -> Counter[str]:
        """How many messages name each frame."""
        return Counter(ros_transforms.bare(location.frame_id) for location in self.locations)


@dataclass(slots=True)
class BagIndex:
    """One pass over a bag.

    Attributes:
        clouds: how clouds are read.
        streams: frames by topic.
        infos: the camera infos of each topic.
        transforms: all static transforms.
        unread: topics of frames in another form, with what they have and what to do.
        transforms_at: places of the messages of all other transforms, by topic, in the order in the bag.
        packets: messages of packets by topic, until `resolve_packets` makes streams of them.
        descriptions: messages in which LiDARs say what they are, by topic (see `packet_streams.description_name`).
        damaged: what cannot be read, and is left out.
    """

    path: Path
    clouds: CloudDecoder
    streams: dict[str, TopicStream] = field(default_factory=dict)
    infos: dict[str, camera_info.CameraInfos] = field(default_factory=dict)
    transforms: ros_transforms.StaticTransforms = field(default_factory=ros_transforms.StaticTransforms)
    transforms_at: dict[str, list[tuple[int, ...]]] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)
    packets: dict[str, PacketStream] = field(default_factory=dict)
    descriptions: dict[str, bytes] = field(default_factory=dict)
    damaged: DamagedFrames = field(default_factory=DamagedFrames)

    def topic(self, types: tuple[str, ...], requested: str | None, key: str) -> str:
        """The topic of these types that was asked for, else the only one.

        Raises:
            SourceError: there is no such topic, or there are several and none was asked for.
        """
        topic = self.optional_topic(types, requested, key)
        if topic is None:
            advice = "".join(f"; {other} has {text}" for other, text in self.unread.items())
            others = (*point_clouds.TYPES, *VIDEO_TYPES, *packed_clouds.TYPES, *packet_streams.TYPES)
            named = " or ".join(name for name in types if name not in others)
            damaged = f"; {self.damaged.text}" if self.damaged else ""
            raise SourceError(f"{self.path} has no message of type {named}{advice}{damaged}")
        return topic

    def optional_topic(self, types: tuple[str, ...], requested: str | None, key: str) -> str | None:
        """As `topic`, but None if the bag has none and none was asked for."""
        there = [
            topic for topic, one in self.streams.items() if one.type_name in types and (one.locations or one.videos)
        ]
        if requested is not None:
            if requested not in there and requested in self.unread:
                raise SourceError(f"{self.path}: {requested} has {self.unread[requested]}")
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

    def camera_topic(self, requested: str | None) -> str:
        """The topic of images that was asked for, else the only one of pictures, else the only one of video.

        Raises:
            SourceError: as `topic`; or a video has no key frame.
        """
        of_images = [(t, one) for t, one in self.streams.items() if one.type_name in IMAGE_TYPES]
        pictures = [topic for topic, one in of_images if one.locations and not one.videos]
        topic = self.topic(IMAGE_TYPES, pictures[0] if not requested and len(pictures) == 1 else requested, "camera")
        stream = self.streams[topic]
        if not stream.locations:
            left_out = "; ".join(video_left_out(track) for track in stream.videos.values())
            raise SourceError(
                f"{self.path}: no picture of the video on {topic} can be decoded: {left_out}. Key frames are those "
                "of type IDR (H.264) or IRAP (H.265), with their parameter sets: let the encoder send one each second"
            )
        return topic

    def lidar_topic(self, requested: str | None) -> str:
        """The topic of clouds that was asked for, else the only one of points, else the only one of packed clouds or
        packets.

        Raises:
            SourceError: as `topic`.
        """
        of_points = [topic for topic, one in self.streams.items() if one.type_name in POINT_TYPES]
        return self.topic(CLOUD_TYPES, of_points[0] if not requested and len(of_points) == 1 else requested, "points")

    def transform(self, target: str, source: str) -> Matrix4 | None:
        """T_target_source (4, 4) along the static transforms; None if they do not connect the two frames.

        Raises:
            SourceError: they connect the frames in ways that contradict each other.
        """
        if ros_transforms.bare(target) == ros_transforms.bare(source):
            return np.eye(4)
        doubts = self.transforms.doubts(target, source)
        if doubts:
            raise SourceError(f"{self.path}: /tf_static is no tree: {'; '.join(doubts)}")
        return self.transforms.transform(target, source)

    def require_one_frame(self, topic: str, requested: str | None, key: str) -> None:
        """Leaves the messages of one frame on a topic: the one that was asked for by `key`, if it names one of several.

        Raises:
            SourceError: the messages name several frames, and none of them was asked for.
        """
        stream = self.streams[topic]
        frames = stream.frames
        # A sensor that sent so little is none: its name is a damaged one.
        odd = {frame for frame, count in frames.items() if count == 1 and frames.total() >= FEW}
        if odd and len(odd) < len(frames):
            text = f"a message on {topic} names the frame {min(odd)!a}, as no other does"
            self._leave_out(stream, [ros_transforms.bare(one.frame_id) not in odd for one in stream.locations], text)
            frames = stream.frames
        if len(frames) < 2:
            return
        if requested is None or ros_transforms.bare(requested) not in frames:
            counts = ", ".join(f"{frame!a} ({count})" for frame, count in frames.most_common(LISTED))
            raise SourceError(
                f"{self.path}: the messages on {topic} name {len(frames)} frames: {counts}. Two sensors publish on it: "
                f"choose one with ?{key}=NAME"
            )
        stream.locations = [
            location
            for location in stream.locations
            if ros_transforms.bare(location.frame_id) == ros_transforms.bare(requested)
        ]

    def require_stamps(self, topic: str) -> None:
        """Leaves out the few messages of a topic whose stamps are far from when they were received, other than all
        others; their headers are damaged."""
        stream = self.streams[topic]
        if stream.type_name in VIDEO_TYPES or len(stream.locations) != len(stream.lags_s) or len(stream.lags_s) < FEW:
            return
        lags_s = np.array(stream.lags_s)
        sound = np.abs(lags_s - np.median(lags_s)) <= STRAY_S
        if 0 < np.count_nonzero(~sound) <= max(1, len(lags_s) // 50):
            stamp_ns = stream.locations[int(np.argmin(sound))].stamp_ns
            text = f"a message on {topic} has the stamp {stamp_ns} ns, far from the time of its receipt"
            self._leave_out(stream, sound.tolist(), text)

    def _leave_out(self, stream: TopicStream, sound: Sequence[bool], text: str) -> None:
        """Leaves the messages of a stream that are `sound`."""
        for location, is_sound in zip(stream.locations, sound, strict=True):
            if not is_sound:
                kind = next((kind for kind, types in _KINDS.items() if stream.type_name in types), RECORD)
                self.damaged.add(kind, location.at, SourceError(f"{self.path}: {text}"))
        stream.locations = [one for one, is_sound in zip(stream.locations, sound, strict=True) if is_sound]

    def connect(self, target: str, source: str, reader: BagReader) -> tuple[Recognition, ...]:
        """If the static transforms do not connect two frames, adds those of other topics (`/tf`) that never change,
        and returns what to tell of that."""
        if self.transforms.transform(target, source) is not None:
            return ()
        self._add_constant_transforms(reader)
        if self.transforms.transform(target, source) is None:
            return ()
        topics = " and ".join(self.transforms_at)
        text = f"/tf_static does not connect {target!a} and {source!a}: transforms on {topics} do, and never change."
        return (Recognition("constant_transforms", text, "warn"),)

    def _add_constant_transforms(self, reader: BagReader) -> None:
        constant: dict[tuple[str, str], ros_transforms.StaticTransform | None] = {}
        for topic in self.transforms_at:
            for place in self.transforms_at[topic][:MAX_TF_MESSAGES]:
                try:
                    joints = ros_transforms.decode_static_transforms(reader(place)).joints
                except DecodeError:
                    continue
                for joint in joints:
                    known = constant.setdefault((joint.parent, joint.child), joint)
                    if known is not None and not np.allclose(known.T_parent_child, joint.T_parent_child, 0.0, UNMOVED):
                        constant[joint.parent, joint.child] = None
        known_frames = set(self.transforms.frames)
        fresh = (joint for joint in constant.values() if joint is not None)
        with suppress(DecodeError):
            self.transforms.add(tuple(j for j in fresh if not {j.parent, j.child} <= known_frames))

    def add(self, entry: BagMessage) -> None:
        """Notes a message, or that it is damaged."""
        name = entry.type_name
        if entry.error is not None:
            self._note_damage(entry, entry.error)
        elif name in packet_streams.TYPES:
            stream_of_packets = self.packets.setdefault(entry.topic, PacketStream(entry.topic, name))
            stream_of_packets.add(entry.data, entry.place, entry.logged_ns)
        elif name in (*IMAGE_TYPES, *CLOUD_TYPES, *VELOCITY_TYPES, *ROTATION_TYPES):
            stream = self.streams.setdefault(entry.topic, TopicStream(name))
            stamp_ns = _header_stamp_ns(entry.data)
            if stamp_ns is None:
                error = SourceError(f"{self.path}: a message on {entry.topic} has no valid header")
                self._note_damage(entry, error)
                return
            if name == messages.POINT_CLOUD and messages.is_empty_cloud(entry.data):
                stream.empty += 1
                return
            if stamp_ns == 0 and name in CLOUD_TYPES:
                stamp_ns = self._stamp_of_points(entry)
            frame_id = sys.intern(messages.header_frame_id(entry.data))
            if name in (messages.COMPRESSED_IMAGE, *VIDEO_TYPES) and not self._is_picture(entry, stream, frame_id):
                return
            stream.locations.append(MessageLocation(stamp_ns, entry.place, name, frame_id))
            stream.lags_s.append((entry.logged_ns - stamp_ns) * 1e-9)
        elif name in (messages.STRING, messages.BYTES) and packet_streams.is_description(entry.data):
            name = packet_streams.description_name(entry.topic, entry.data, self.descriptions)
            if name in self.descriptions or len(self.descriptions) < LISTED:
                self.descriptions[name] = entry.data
        elif name == messages.CAMERA_INFO:
            infos = self.infos.get(entry.topic, camera_info.CameraInfos())
            self._decoded(entry, infos.add)
            if infos.count:
                self.infos[entry.topic] = infos
        elif name == messages.TF and entry.topic == TF_STATIC:
            self._decoded(entry, self._add_static_transforms)
        elif name in message_decoding.REFUSED and name != messages.TF:
            self.leave_unread(entry.topic, f"{name}: {message_decoding.REFUSED[name]}")
        elif name == messages.TF:
            self.transforms_at.setdefault(entry.topic, []).append(entry.place)

    def resolve_packets(self, metadata: bytes | str | None) -> None:
        """Makes the sweeps of all packets, after the whole bag was read. `metadata`: those of the LiDAR, or their
        topic, if a person says so."""
        for topic, packets in self.packets.items():
            try:
                sensor = packets.sensor(self.descriptions, metadata)
                sweeps, notes = packets.sweeps(sensor)
            except DecodeError as error:
                self.leave_unread(topic, f"packets of a LiDAR: {error}")
                continue
            stream = self.streams.setdefault(topic, TopicStream(packets.type_name, notes=notes))
            for sweep in sweeps:
                place = MessageLocation(sweep.stamp_ns, sweep.places[0], stream.type_name, sensor.frame_id, sweep)
                stream.locations.append(place)
                stream.lags_s.append((sweep.logged_ns - sweep.stamp_ns) * 1e-9)
            frames = self.transforms.frames
            if sensor.pose is not None and sensor.frame_id not in frames and sensor.pose[0] in frames:
                with suppress(DecodeError):
                    joint = ros_transforms.StaticTransform(sensor.pose[0], sensor.frame_id, sensor.pose[1])
                    self.transforms.add((joint,))

    def leave_unread(self, topic: str, text: str) -> None:
        """Notes a topic that has frames in another form, and what to do."""
        if len(self.unread) < LISTED:
            self.unread[topic] = text

    def _is_picture(self, entry: BagMessage, stream: TopicStream, frame_id: str) -> bool:
        """Notes a packet of video. Returns False if its picture cannot be decoded, or if it has none."""
        try:
            video = message_decoding.video_data(entry.type_name, entry.data)
        except DecodeError as error:
            if entry.type_name in VIDEO_TYPES:
                self.leave_unread(entry.topic, f"a damaged {entry.type_name}: {error}")
            return entry.type_name not in VIDEO_TYPES  # a picture is refused when it is used
        if video is None:
            return True
        codec = codec_of(video[0])
        if codec is None:
            self.leave_unread(entry.topic, f"video of the format {video[0][:MAX_FORMAT]!a}: H.264 and H.265 are read")
            return False
        track = stream.videos.setdefault(ros_transforms.bare(frame_id), VideoTrack(codec))
        return track.add(video[1], entry.place)

    def _stamp_of_points(self, entry: BagMessage) -> int:
        """Stamp of a cloud without one, from its points; 0 if they give none. If the cloud cannot be decoded, that is
        reported when it is used."""
        try:
            return self.clouds.decode(entry.type_name, entry.data).stamp_ns
        except DecodeError:
            return 0

    def _add_static_transforms(self, data: bytes) -> None:
        decoded = ros_transforms.decode_static_transforms(data)
        self.transforms.refuse(decoded.refused)
        self.transforms.add(decoded.joints)

    def _decoded(self, entry: BagMessage, decode: Callable[[bytes], None]) -> None:
        try:
            decode(entry.data)
        except DecodeError as error:
            refused = SourceError(f"{self.path}: a {entry.type_name} on {entry.topic} is refused: {error}")
            refused.__cause__ = error
            self._note_damage(entry, refused)

    def _note_damage(self, entry: BagMessage, error: SourceError) -> None:
        kind = next((kind for kind, types in _KINDS.items() if entry.type_name in types), RECORD)
        if entry.type_name in _USED or not entry.topic:
            self.damaged.add(kind, entry.place, error)


def video_left_out(track: VideoTrack) -> str:
    """How many pictures of a video were left out, by cause."""
    return ", ".join(f"{count} {cause}" for cause, count in track.left_out.items()) or "there is none"


def build_index(storage: BagStorage, clouds: CloudDecoder, metadata: str | None = None) -> BagIndex:
    """Makes the index of a bag whose clouds are read by `clouds`. `metadata`: a file or a topic with those of the LiDAR
    whose packets are read.

    Raises:
        SourceError: a file is absent, cut off or damaged, or a message is not what its topic says.
    """
    index = BagIndex(storage.path, clouds)
    for entry in storage.entries():
        index.add(entry)
    given: bytes | str | None = metadata
    if metadata is not None and metadata not in index.descriptions:
        try:
            with expand_home(metadata).open("rb") as file:
                given = file.read(MAX_DESCRIPTION_BYTES)
        except OSError as error:
            raise SourceError(f"cannot read metadata={metadata}: {error.strerror}") from error
    index.resolve_packets(given)
    for topic, stream in index.streams.items():
        if stream.empty:
            text = f"{stream.empty} of the clouds on {topic} have no point, and are left out."
            stream.notes = (*stream.notes, Recognition("clouds_empty", text, "warn"))
        if stream.empty and not stream.locations:
            index.leave_unread(topic, "clouds without a point")
    return index


def _header_stamp_ns(data: bytes) -> int | None:
    layout = _HEADER.get(data[1]) if len(data) >= 12 else None
    if layout is None:
        return None
    seconds, nanoseconds = layout.unpack_from(data, 4)
    return seconds * 1_000_000_000 + nanoseconds if seconds >= 0 and nanoseconds < 1_000_000_000 else None


VEHICLE: Final = ("odom", "base_link")
"""The frame in which a vehicle moves and the vehicle's own frame, as REP 105 names them."""

LISTED: Final = 12
"""How many joints or frames an error lists."""


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
        joints_text = ", ".join(f"{parent},{child}" for parent, child in there[:LISTED])
        more = ", ..." if len(there) > LISTED else ""
        raise SourceError(
            f"{index.path}: {topic} does not say how {frames[1]!a} moves in {frames[0]!a}; name the frames with "
            f"?moving=PARENT,CHILD; there: {joints_text or 'none'}{more}"
        )
    return tuple(sorted(motions, key=lambda motion: motion.stamp_ns))


def _motions(index: BagIndex, reader: BagReader, topic: str, frames: tuple[str, str]) -> list[EgoMotion]:
    moving = ros_transforms.MovingFrame(*frames)
    try:
        motions = [moving.motion(data) for data in _messages(index, reader, topic)]
    except DecodeError as error:
        raise SourceError(f"{index.path}: a message on {topic} is refused: {error}") from error
    return [motion for motion in motions if motion is not None]


def _joints(index: BagIndex, reader: BagReader, topic: str) -> set[tuple[str, str]]:
    return {joint for data in _messages(index, reader, topic) for joint in ros_transforms.frames_in(data)}


def _messages(index: BagIndex, reader: BagReader, topic: str) -> Iterable[bytes]:
    return (reader(place) for place in index.transforms_at[topic])
