"""A recording on the air: its frames on Zenoh keys at the cadence at which they were recorded."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, cast

import zenoh

from coec.adapters.frames import msgpack_frames
from coec.adapters.ros import messages, outgoing
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import PairConfig
from coec.errors import UsageError

NS_PER_S = 1_000_000_000
CAMERA, LIDAR, EGO = "camera", "lidar", "ego"

Frame = CameraFrame | LidarFrame | EgoMotion


@dataclass(frozen=True, slots=True)
class Streams:
    """The keys of a pair; `ego` None means that ego-motion is not published."""

    camera: str
    lidar: str
    ego: str | None

    @classmethod
    def of_pair(cls, pair: PairConfig) -> Streams:
        """Those of a configuration.

        Raises:
            UsageError: it names topics of ROS.
        """
        topics = [stream.topic for stream in pair.streams.values() if stream.topic]
        if topics:
            raise UsageError(f"{', '.join(topics)}: frames of a pair are played on keys, and these are topics of ROS")
        return cls(pair.camera.place, pair.lidar.place, pair.ego.place if pair.ego else None)

    @classmethod
    def default(cls, pair: str) -> Streams:
        """`sensors/<pair>/camera`, `lidar` and `ego`."""
        return cls(f"sensors/{pair}/camera", f"sensors/{pair}/lidar", f"sensors/{pair}/ego")


@dataclass(slots=True)
class Played:
    """What has been published: frames by stream, bytes, and how far the latest was behind its time, seconds."""

    frames: Counter[str]
    bytes: int = 0
    late_s: float = 0.0
    latest_late_s: float = 0.0


class Player:
    """Publishes frames. Senders wait rather than drop: what is lost is then lost by the receiver, which counts it."""

    def __init__(self, session: zenoh.Session, streams: Streams, encoding: Literal["msgpack", "cdr"]) -> None:
        self._encoding = encoding
        keys = {CAMERA: streams.camera, LIDAR: streams.lidar, EGO: streams.ego}
        self._publishers = {
            stream: session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
            for stream, key in keys.items()
            if key is not None
        }
        self._sequence: Counter[str] = Counter()
        self.played = Played(Counter())

    def wait_for_listener(self, timeout_s: float) -> list[str]:
        """Until somebody subscribes to every stream, at most so long; the keys that nobody listens to."""
        deadline_s = time.monotonic() + timeout_s
        changed = threading.Event()
        listeners = [p.declare_matching_listener(lambda _: changed.set()) for p in self._publishers.values()]
        try:
            while True:
                changed.clear()
                deaf = [str(p.key_expr) for p in self._publishers.values() if not is_heard(p)]
                if not deaf or not changed.wait(max(deadline_s - time.monotonic(), 0.0)):
                    return deaf
        finally:
            for listener in listeners:
                listener.undeclare()

    def play(
        self,
        frames: Iterable[Frame],
        rate: float,
        stop: threading.Event,
        heard: Callable[[Frame, Played], None],
    ) -> Played:
        """Publishes every frame when it is due, `rate` times as fast as it was recorded; 0 = without waiting.

        Times are counted from the first frame, so that delays do not add up. `heard` is told after each frame; `stop`
        ends it before the next one.
        """
        start_s = time.monotonic()
        first_ns: int | None = None
        for frame in frames:
            stream = stream_of(frame)
            if stop.is_set():
                break
            if stream not in self._publishers:
                continue
            payload, encoding = self._encoded(stream, frame)
            if first_ns is None:
                first_ns, start_s = frame.stamp_ns, time.monotonic()
            due_s = start_s + (frame.stamp_ns - first_ns) / NS_PER_S / rate if rate > 0 else 0.0
            if rate > 0 and stop.wait(max(due_s - time.monotonic(), 0.0)):
                break
            self._publishers[stream].put(payload, encoding=encoding)
            self.played.frames[stream] += 1
            self.played.bytes += len(payload)
            if rate > 0:
                self.played.latest_late_s = max(time.monotonic() - due_s, 0.0)
                self.played.late_s = max(self.played.late_s, self.played.latest_late_s)
            heard(frame, self.played)
        return self.played

    def close(self) -> None:
        """Withdraws the publishers."""
        for publisher in self._publishers.values():
            publisher.undeclare()

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


def repeated(passes: Callable[[], Iterable[Frame]], shift_ns: int, pause_ns: int, forever: bool) -> Iterator[Frame]:
    """The frames of `passes()` with `shift_ns` added to their stamps; if `forever`, again and again, each time
    `pause_ns` after the last frame of the pass before: sensor time never steps back."""
    while True:
        first_ns, last_ns = None, 0
        for frame in passes():
            first_ns = frame.stamp_ns if first_ns is None else first_ns
            last_ns = frame.stamp_ns
            yield replace(frame, stamp_ns=frame.stamp_ns + shift_ns)
        if not forever or first_ns is None:
            return
        shift_ns += last_ns - first_ns + pause_ns


def is_heard(publisher: zenoh.Publisher) -> bool:
    """Whether somebody subscribes to what it publishes."""
    # The stubs of eclipse-zenoh 1.10 call it a bool; it is a `MatchingStatus`, which is always true.
    return cast("zenoh.MatchingStatus", publisher.matching_status).matching


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
