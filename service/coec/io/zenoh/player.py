"""Publishes the frames or messages of a recording, on the native keys of a pair or on ROS 2 topics, at the pace at
which they were recorded.
"""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal, Protocol, TypeVar

import zenoh
from pydantic import TypeAdapter, ValidationError

from coec.calibration.types import NS_PER_S, CameraFrame, EgoMotion, Frame, LidarFrame
from coec.config import OpenPairConfig, TopicName
from coec.errors import UsageError
from coec.io import msgpack_frames
from coec.io.ros import message_encoding, messages
from coec.io.ros.topics import TopicMessage, qos_of
from coec.io.ros.wire_format import Dialect, Node, RmwZenoh, Ros2dds
from coec.io.zenoh.ros_node import RosNode, RosPublisher, RosPublishers, has_subscribers


class Stamped(Protocol):
    """An item with a time stamp."""

    @property
    def stamp_ns(self) -> int:
        """Nanoseconds, by the clock of the recording."""


T = TypeVar("T", bound=Stamped)


@dataclass(slots=True)
class Played:
    """What has been published: frames (or messages) by stream, bytes, and the delays behind the due times, seconds: the
    largest (`late_s`) and that of the latest item."""

    frames: Counter[str]
    bytes: int = 0
    late_s: float = 0.0
    latest_late_s: float = 0.0


def paced(
    items: Iterable[T],
    rate: float,
    stop: threading.Event,
    send: Callable[[T], tuple[str, int]],
    on_sent: Callable[[T, Played], None],
    played: Played,
) -> Played:
    """Sends every item when it is due, `rate` times as fast as it was recorded; 0 = without waiting.

    Due times count from the first item, so that delays do not add up.

    Args:
        items: in ascending order of their stamps.
        rate: multiple of the recorded speed.
        stop: ends the playing before the next item.
        send: publishes an item and returns its stream and number of bytes.
        on_sent: called after each item.
        played: counters to go on with; also returned.
    """
    start_s = time.monotonic()
    first_ns: int | None = None
    for item in items:
        if stop.is_set():
            break
        if first_ns is None:
            first_ns, start_s = item.stamp_ns, time.monotonic()
        due_s = start_s + (item.stamp_ns - first_ns) / NS_PER_S / rate if rate > 0 else 0.0
        if rate > 0 and stop.wait(max(due_s - time.monotonic(), 0.0)):
            break
        stream, size = send(item)
        played.frames[stream] += 1
        played.bytes += size
        if rate > 0:
            played.latest_late_s = max(time.monotonic() - due_s, 0.0)
            played.late_s = max(played.late_s, played.latest_late_s)
        on_sent(item, played)
    return played


def repeated(
    passes: Callable[[], Iterable[T]], later: Callable[[T, int], T], shift_ns: int, pause_ns: int, forever: bool
) -> Iterator[T]:
    """The items of `passes()`, each moved by `shift_ns` with `later`. If `forever`, this repeats: each pass begins
    `pause_ns` after the last item of the pass before, so that time never steps back."""
    while True:
        first_ns, last_ns = None, 0
        for item in passes():
            first_ns = item.stamp_ns if first_ns is None else first_ns
            last_ns = item.stamp_ns
            yield later(item, shift_ns)
        if not forever or first_ns is None:
            return
        shift_ns += last_ns - first_ns + pause_ns


CAMERA, LIDAR, EGO = "camera", "lidar", "ego"


@dataclass(frozen=True, slots=True)
class StreamKeys:
    """The keys of a pair; `ego` None: ego-motion is not published."""

    camera: str
    lidar: str
    ego: str | None

    @classmethod
    def of_pair(cls, pair: OpenPairConfig) -> StreamKeys:
        """The keys in a configuration.

        Raises:
            UsageError: the configuration names ROS topics.
        """
        topics = [stream.topic for stream in pair.streams.values() if stream.topic]
        if topics:
            raise UsageError(f"{', '.join(topics)}: frames of a pair are played on keys, and these are topics of ROS")
        return cls(pair.camera.place, pair.lidar.place, pair.ego.place if pair.ego else None)

    @classmethod
    def default(cls, pair: str) -> StreamKeys:
        """`sensors/<pair>/camera`, `lidar` and `ego`."""
        return cls(f"sensors/{pair}/camera", f"sensors/{pair}/lidar", f"sensors/{pair}/ego")

    def keys(self) -> dict[str, str]:
        """Keys by stream."""
        named = {CAMERA: self.camera, LIDAR: self.lidar, EGO: self.ego}
        return {stream: key for stream, key in named.items() if key is not None}

    def stream_of(self, frame: Frame) -> str:
        """The stream of a frame, by the frame's kind."""
        return stream_of(frame)


@dataclass(frozen=True, slots=True)
class SensorKeys:
    """A key for each sensor of a vehicle; a sensor is named by its frame id."""

    sensors: tuple[str, ...]

    def keys(self) -> dict[str, str]:
        """`sensors/<sensor>`."""
        return {sensor: f"sensors/{sensor}" for sensor in self.sensors}

    def stream_of(self, frame: Frame) -> str:
        """The stream of a frame, by its sensor."""
        return frame.frame_id


class Player:
    """Publishes the frames of a pair, or of all sensors. The sender waits instead of dropping, so that only the
    receiver loses frames, which it counts."""

    def __init__(
        self, session: zenoh.Session, streams: StreamKeys | SensorKeys, encoding: Literal["msgpack", "cdr"]
    ) -> None:
        self._encoding = encoding
        self._stream_of = streams.stream_of
        self._publishers = {
            stream: session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
            for stream, key in streams.keys().items()
        }
        self._sequence: Counter[str] = Counter()
        self.played = Played(Counter())

    def wait_for_listener(self, timeout_s: float) -> list[str]:
        """Wait until every stream has a subscriber, at most `timeout_s`. Returns the keys that still have none."""
        deadline_s = time.monotonic() + timeout_s
        changed = threading.Event()
        listeners = [p.declare_matching_listener(lambda _: changed.set()) for p in self._publishers.values()]
        try:
            while True:
                changed.clear()
                unmatched = [str(p.key_expr) for p in self._publishers.values() if not has_subscribers(p)]
                if not unmatched or not changed.wait(max(deadline_s - time.monotonic(), 0.0)):
                    return unmatched
        finally:
            for listener in listeners:
                listener.undeclare()

    def play(
        self,
        frames: Iterable[Frame],
        rate: float,
        stop: threading.Event,
        on_sent: Callable[[Frame, Played], None],
    ) -> Played:
        """Publishes every frame when it is due, see `paced`; frames of a stream without a key are left out."""
        ours = (frame for frame in frames if self._stream_of(frame) in self._publishers)
        return paced(ours, rate, stop, self._send, on_sent, self.played)

    def close(self) -> None:
        """Withdraws the publishers."""
        for publisher in self._publishers.values():
            publisher.undeclare()

    def _send(self, frame: Frame) -> tuple[str, int]:
        stream = self._stream_of(frame)
        payload, encoding = self._encoded(stream, frame)
        self._publishers[stream].put(payload, encoding=encoding)
        return stream, len(payload)

    def _encoded(self, stream: str, frame: Frame) -> tuple[bytes, zenoh.Encoding]:
        numbered = replace(frame, sequence=self._sequence[stream])
        self._sequence[stream] += 1
        if self._encoding == "msgpack":
            return msgpack_frames.encode(numbered), zenoh.Encoding("application/msgpack")
        type_name, payload = _cdr(numbered)
        return payload, zenoh.Encoding(f"application/cdr;{type_name}")


def stream_of(frame: Frame) -> str:
    """`camera`, `lidar` or `ego`."""
    match frame:
        case CameraFrame():
            return CAMERA
        case LidarFrame():
            return LIDAR
        case EgoMotion():
            return EGO


def shifted(frame: Frame, shift_ns: int) -> Frame:
    """The frame with `shift_ns` added to its stamp."""
    return replace(frame, stamp_ns=frame.stamp_ns + shift_ns)


def _cdr(frame: Frame) -> tuple[str, bytes]:
    match frame:
        case CameraFrame():
            return message_encoding.encode_image(frame)
        case LidarFrame():
            return messages.POINT_CLOUD, message_encoding.encode_cloud(frame)
        case EgoMotion():
            return message_encoding.encode_motion(frame)


Middleware = Literal["rmw_zenoh", "ros2dds"]

NODE: Final = "coec_play"

TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,127}/msg/[A-Za-z][A-Za-z0-9]{0,127}")
"""Full name of a message type (rosidl_parser, definition.py)."""

_TOPIC: Final = TypeAdapter[str](TopicName)

MATCHING_POLL_S: Final = 0.05
"""Pause between two looks for subscribers."""


def dialect_of(middleware: Middleware, session: zenoh.Session, domain: int, namespace: str) -> Dialect:
    """The dialect of a player in a session: that of an rmw_zenoh node in a domain, or of a bridge with a namespace."""
    name = str(session.info.zid())
    if middleware == "ros2dds":
        return Ros2dds(name, namespace)
    return RmwZenoh(Node(domain, name, 0, "/", NODE), messages.type_hash)


def is_playable(middleware: Middleware, topic: str, type_name: str) -> bool:
    """Whether a topic has a key. Topic and type must be valid ROS names, since a file may hold any text and a key with
    `*` is none. For rmw_zenoh the definition of the type must also be known, as its key holds the hash of the type."""
    try:
        _TOPIC.validate_python(topic)
    except ValidationError:
        return False
    return TYPE.fullmatch(type_name) is not None and (middleware == "ros2dds" or messages.is_known(type_name))


class TopicPlayer:
    """Publishes on topics. The sender waits instead of dropping, so that only the receiver loses messages."""

    def __init__(self, session: zenoh.Session, dialect: Dialect, topics: Mapping[str, str]) -> None:
        """`topics`: types by name."""
        self._node = RosNode(session, dialect)
        self._all = RosPublishers(session, self._node)
        self._publishers: dict[str, RosPublisher] = {
            topic: self._all.publisher(topic, type_name, qos_of(topic), zenoh.CongestionControl.BLOCK)
            for topic, type_name in topics.items()
        }

    def wait_for_listener(self, topics: Iterable[str], timeout_s: float, stop: threading.Event) -> list[str]:
        """Wait until each of these topics has a subscriber, at most `timeout_s`. Returns the topics that still have
        none."""
        pending = list(topics)
        deadline_s = time.monotonic() + timeout_s
        while True:
            unmatched = [topic for topic in pending if not self._publishers[topic].has_subscribers]
            if not unmatched or time.monotonic() > deadline_s or stop.wait(MATCHING_POLL_S):
                return unmatched

    def play(
        self,
        items: Iterable[TopicMessage],
        rate: float,
        stop: threading.Event,
        on_sent: Callable[[TopicMessage, Played], None],
    ) -> Played:
        """Publishes every message on one of the player's topics when it is due, see `paced`; others are left out."""
        ours = (message for message in items if message.topic in self._publishers)
        return paced(ours, rate, stop, self._send, on_sent, Played(Counter()))

    def close(self) -> None:
        """Withdraws tokens and publishers."""
        self._all.close()
        self._node.close()

    def _send(self, message: TopicMessage) -> tuple[str, int]:
        self._publishers[message.topic].put(message.data, time.time_ns())
        return message.topic, len(message.data)
