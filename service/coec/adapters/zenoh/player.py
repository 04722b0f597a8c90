"""Publishes the frames of a recording on the keys of a pair, at the pace at which they were recorded."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal

import zenoh

from coec.adapters.frames import msgpack_frames
from coec.adapters.ros import messages, outgoing
from coec.adapters.zenoh.cadence import Played, paced
from coec.adapters.zenoh.matching import has_subscribers
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import OpenPairConfig
from coec.errors import UsageError

CAMERA, LIDAR, EGO = "camera", "lidar", "ego"

Frame = CameraFrame | LidarFrame | EgoMotion


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
            return _msgpack(numbered), zenoh.Encoding("application/msgpack")
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


def _msgpack(frame: Frame) -> bytes:
    match frame:
        case CameraFrame():
            return msgpack_frames.encode_camera(frame)
        case LidarFrame():
            return msgpack_frames.encode_lidar(frame)
        case EgoMotion():
            return msgpack_frames.encode_ego(frame)


def _cdr(frame: Frame) -> tuple[str, bytes]:
    match frame:
        case CameraFrame():
            return outgoing.encode_image(frame)
        case LidarFrame():
            return messages.POINT_CLOUD, outgoing.encode_cloud(frame)
        case EgoMotion():
            return outgoing.encode_motion(frame)
