"""The recording of one pair in a ROS 2 bag, or a window that coec recorded.

A bag is gone through once (`index`); messages are read again when it is their turn.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from coec.adapters.mcap.windows import is_window, read_window
from coec.adapters.ros import incoming
from coec.calibration.frames.concatenation import SeveralOrigins
from coec.calibration.frames.origin import ApparentOrigin
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, LidarFrame, Matrix4, Rig
from coec.config import CalibrationConfig, LimitsConfig
from coec.errors import DecodeError, SourceError, UsageError
from coec.sources.bag.index import CLOUD_TYPES, IMAGE_TYPES, MOTION_TYPES, Place, index_of
from coec.sources.bag.rig import rig_of_bag
from coec.sources.bag.storage import Reader, Storage, open_storage
from coec.sources.clouds import measured_from
from coec.sources.recording import (
    MOTION_REACH_NS,
    FramewiseRecording,
    Message,
    RecordedFrame,
    Recording,
    chosen_indices,
)
from coec.sources.spec import SourceSpec

_EGO, _LIDAR, _CAMERA = 0, 1, 2
"""Order of messages with equal stamps, as in `sources.recording`."""


_ADVICE = {
    ApparentOrigin.cause: "Name the LiDAR's frame with ?lidar_frame=..., if /tf_static has it.",
    SeveralOrigins.cause: "Choose the topic of one LiDAR with ?points=..., or one by its number with ?lidar_source=N, "
    "if a field of the points tells it.",
}


def open_bag(spec: SourceSpec) -> Recording:
    """`BAG[?camera=/TOPIC][&points=/TOPIC][&odometry=/TOPIC][&intrinsics=FILE or /TOPIC][&lidar_frame=NAME]
    [&lidar_source=N]`.

    Without a query, a recorded window is opened as such. In any other bag topics are found by their type where there is
    only one of it. Intrinsics come from the `CameraInfo` of the camera's frame (or of the topic named), or from a YAML
    file; the extrinsic from that file, else from `/tf_static`, over any number of joints. Where `/tf_static` does not
    lead to the frame of the odometry, its twist is taken as the LiDAR's own. Points that a driver gives in another
    frame than the LiDAR's (`base_link`) are taken back to it where `lidar_frame` names it and `/tf_static` leads there.
    Of a cloud of several LiDARs `lidar_source` chooses one (see `adapters.ros.source_field`).

    Raises:
        UsageError: unknown query key, or one that is no number.
        SourceError: no bag, cut off or damaged; no topic, or several, of a type; no intrinsics, no extrinsic.
        WindowError: a recorded window that is damaged.
    """
    query = spec.only("camera", "points", "odometry", "intrinsics", "lidar_frame", "lidar_source")
    if not query and spec.path.suffix == ".mcap" and is_window(spec.path):
        return _window_recording(spec.path)
    source = _number(query.get("lidar_source"))
    storage = open_storage(spec.path)
    index = index_of(storage)
    camera_topic = index.topic(IMAGE_TYPES, query.get("camera"), "camera")
    lidar_topic = index.topic(CLOUD_TYPES, query.get("points"), "points")
    motion_topic = index.optional_topic(MOTION_TYPES, query.get("odometry"), "odometry")
    streams = Streams(
        index.streams[camera_topic].ordered(),
        index.streams[lidar_topic].ordered(),
        [] if motion_topic is None else index.streams[motion_topic].ordered(),
    )
    with storage.open() as reader:
        camera = _load(storage, reader, streams.camera[0])
        cloud = _load(storage, reader, streams.lidar[0], source)
        motion = _load(storage, reader, streams.motion[0]) if streams.motion else None
    if not isinstance(camera, CameraFrame) or not isinstance(motion, EgoMotion | None):
        raise SourceError(f"{spec.path}: {camera_topic} holds no images, or {motion_topic} no motion")
    lidar_frame = query.get("lidar_frame", cloud.frame_id)
    T_cloud_lidar = index.transform(cloud.frame_id.lstrip("/"), lidar_frame.lstrip("/"))
    if T_cloud_lidar is None:
        raise SourceError(f"{spec.path}: /tf_static does not connect {cloud.frame_id!r} and {lidar_frame!r}")
    rig = rig_of_bag(index, query.get("intrinsics"), camera, lidar_frame, motion)
    name = f"{spec.path.name}{camera_topic}"
    return BagRecording(name, rig, rig.T_camera_lidar_nominal, storage, streams, T_cloud_lidar, source)


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


@dataclass(frozen=True, slots=True)
class Streams:
    """Places of a pair's messages, each ascending by stamp; `motion` may be empty."""

    camera: list[Place]
    lidar: list[Place]
    motion: list[Place]


@dataclass(frozen=True, slots=True, eq=False)
class BagRecording:
    """A `Recording` whose streams have their own cadence.

    Attributes:
        storage: of the bag.
        streams: places of the messages.
        T_cloud_lidar: (4, 4) pose of the LiDAR in the frame in which the points are given.
        source: number of the LiDAR, of clouds of several.
    """

    name: str
    rig: Rig
    T_camera_lidar_start: Matrix4
    storage: Storage
    streams: Streams
    T_cloud_lidar: Matrix4
    source: int | None = None
    configuration: CalibrationConfig | None = None

    @property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames, ascending, nanoseconds."""
        return tuple(place.stamp_ns for place in self.streams.camera)

    @property
    def sweep_stamps_ns(self) -> tuple[int, ...]:
        """See `Recording`."""
        return tuple(place.stamp_ns for place in self.streams.lidar)

    @property
    def motion_stamps_ns(self) -> tuple[int, ...]:
        """See `Recording`."""
        return tuple(place.stamp_ns for place in self.streams.motion)

    def messages(self, cameras: Collection[int] | None = None) -> Iterator[Message]:
        """See `Recording.messages`. Of the sweeps, the nearest to each chosen camera frame is handed out."""
        chosen = [self.streams.camera[index] for index in chosen_indices(cameras, len(self.streams.camera))]
        sweeps, motions = self.streams.lidar, self.streams.motion
        if cameras is not None:
            sweeps = sorted({min(sweeps, key=lambda place: abs(place.stamp_ns - c.stamp_ns)) for c in chosen})
            motions = [m for m in motions if any(abs(m.stamp_ns - c.stamp_ns) <= MOTION_REACH_NS for c in chosen)]
        queue = [
            (place.stamp_ns, kind, place)
            for kind, places in ((_EGO, motions), (_LIDAR, sweeps), (_CAMERA, chosen))
            for place in places
        ]
        with self.storage.open() as reader:
            for _, _, place in sorted(queue):
                message = _load(self.storage, reader, place, self.source)
                yield self._from_origin(message) if isinstance(message, LidarFrame) else message

    def _from_origin(self, cloud: LidarFrame) -> LidarFrame:
        return measured_from(cloud, self.T_cloud_lidar, self.rig.lidar_frame, self.storage.path, _ADVICE)


def _number(text: str | None) -> int | None:
    try:
        return None if text is None else int(text)
    except ValueError:
        raise UsageError(f"lidar_source={text}: it is a whole number, as in the points' field") from None


def _load(storage: Storage, reader: Reader, place: Place, source: int | None = None) -> Message:
    data = reader.read(place.at)
    try:
        return incoming.decode(place.type_name, data, LimitsConfig(), source=source)
    except DecodeError as error:
        raise SourceError(f"{storage.path}: the {place.type_name} of {place.stamp_ns} ns: {error}") from error
