"""ROS 2 bags and windows that coec recorded, as the recording of one pair or as all their topics.

A bag is read through once for its index (`index`); each message is read again when it is its turn.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from coec.calibration.frames.lidar_origin import ApparentOrigin, SeveralOrigins
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, LidarFrame, Matrix4, Rig
from coec.config import CalibrationConfig
from coec.errors import DecodeError, SourceError, UsageError
from coec.io.mcap.window_reader import is_window, read_window
from coec.io.recordings import bag_index, recording_source
from coec.io.recordings.bag_storage import BagReader, BagStorage, open_storage
from coec.io.recordings.cloud_files import measured_from
from coec.io.ros.topics import TopicInfo, TopicMessage

_EGO, _LIDAR, _CAMERA = 0, 1, 2
"""Order of messages with equal stamps, as in `sources.recording`."""


_ADVICE = {
    ApparentOrigin.cause: "Name the LiDAR's frame with ?lidar_frame=..., if /tf_static has it.",
    SeveralOrigins.cause: "Choose the topic of one LiDAR with ?points=..., or one by its number with ?lidar_source=N, "
    "if a field of the points tells it.",
}


def open_bag(spec: recording_source.SourceSpec) -> recording_source.RecordingSource:
    """`BAG[?camera=/TOPIC][&points=/TOPIC][&odometry=/TOPIC][&intrinsics=FILE or /TOPIC][&lidar_frame=NAME]
    [&moving=PARENT,CHILD][&time=FIELD,UNIT[,BASE]][&lidar_source=N]`.

    Without a query, a recorded window is opened as such. In any other bag:

    - Topics are found by their type if there is only one of that type.
    - Intrinsics come from the `CameraInfo` of the camera's frame (or of the topic `intrinsics`), or from a YAML file.
    - The extrinsic comes from that file, else from `/tf_static`, over any number of joints.
    - If a driver gives points in another frame than the LiDAR's (`base_link`), `lidar_frame` names the LiDAR's frame,
      and the points are moved back to it along `/tf_static`.
    - If no topic gives a velocity, the motion comes from the transforms of `/tf` between the frames that `moving` names
      (default: `odom` and `base_link`), else the rotation from an IMU. If `/tf_static` does not lead to the frame of
      the odometry, its twist is taken as the LiDAR's own.
    - `time` says how points are timed, if their values leave it open (see `config.PointTimeConfig`).
    - `lidar_source` chooses one LiDAR of a cloud of several (see `adapters.ros.source_field`).

    Raises:
        UsageError: unknown query key, or an invalid value.
        SourceError: no bag, cut off or damaged; no topic, or several, of a type; no intrinsics, no extrinsic.
        WindowError: a recorded window is damaged.
    """
    query = spec.only("camera", "points", "odometry", "intrinsics", "lidar_frame", "moving", "time", "lidar_source")
    if not query and spec.path.suffix == ".mcap" and is_window(spec.path):
        return _window_recording(spec.path)
    clouds, frames = (
        bag_index.CloudDecoder.from_query(query.get("time"), query.get("lidar_source")),
        _frames(query.get("moving")),
    )
    storage = open_storage(spec.path)
    index = bag_index.build_index(storage, clouds)
    camera_topic = index.topic(bag_index.IMAGE_TYPES, query.get("camera"), "camera")
    lidar_topic = index.topic(bag_index.CLOUD_TYPES, query.get("points"), "points")
    with storage.open() as reader:
        streams = _streams(index, reader, camera_topic, lidar_topic, (frames, query.get("odometry")))
        camera = _load(storage, reader, streams.camera[0], clouds)
        cloud = _load(storage, reader, streams.lidar[0], clouds)
        motions = [*streams.moved[:1], *(_load(storage, reader, place, clouds) for place in streams.motion[:1])]
        motion = motions[0] if motions else None
    if not isinstance(camera, CameraFrame) or not isinstance(motion, EgoMotion | None):
        raise SourceError(f"{spec.path}: {camera_topic} holds no images, or no motion on the topic named for it")
    lidar_frame = query.get("lidar_frame", cloud.frame_id)
    T_cloud_lidar = index.transform(cloud.frame_id, lidar_frame)
    if T_cloud_lidar is None:
        raise SourceError(f"{spec.path}: /tf_static does not connect {cloud.frame_id!r} and {lidar_frame!r}")
    rig = bag_index.rig_of_bag(index, query.get("intrinsics"), camera_topic, camera, lidar_frame, motion)
    name = f"{spec.path.name}{camera_topic}"
    return BagRecording(name, rig, rig.T_camera_lidar_nominal, storage, streams, T_cloud_lidar, clouds)


def _window_recording(path: Path) -> recording_source.FramewiseRecording:
    window, configuration = read_window(path)

    def frame_of(pair: FramePair) -> recording_source.RecordedFrame:
        return recording_source.RecordedFrame(
            pair.camera.stamp_ns, lambda: pair.camera, pair.lidar.stamp_ns, lambda: pair.lidar
        )

    return recording_source.FramewiseRecording(
        window.window_id,
        window.rig,
        window.T_camera_lidar_start,
        tuple(frame_of(pair) for pair in window.pairs),
        tuple(pair.motion for pair in window.pairs if pair.motion is not None),
        configuration,
    )


@dataclass(frozen=True, slots=True)
class PairStreams:
    """Places of a pair's messages, each ascending by stamp; `motion` may be empty.

    Attributes:
        moved: the motion itself, instead of `motion`, if it was taken from transforms; ascending by stamp.
    """

    camera: list[bag_index.MessageLocation]
    lidar: list[bag_index.MessageLocation]
    motion: list[bag_index.MessageLocation]
    moved: tuple[EgoMotion, ...] = ()

    @property
    def motions(self) -> list[bag_index.MessageLocation | EgoMotion]:
        """`motion` or `moved`, whichever is not empty."""
        return [*self.motion, *self.moved]


@dataclass(frozen=True, slots=True, eq=False)
class BagRecording:
    """A `Recording` whose streams have their own cadence.

    Attributes:
        storage: storage of the bag.
        streams: places of the messages.
        T_cloud_lidar: (4, 4) pose of the LiDAR in the frame in which the points are given.
        clouds: how the clouds are read.
    """

    name: str
    rig: Rig
    T_camera_lidar_start: Matrix4
    storage: BagStorage
    streams: PairStreams
    T_cloud_lidar: Matrix4
    clouds: bag_index.CloudDecoder
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
        return tuple(motion.stamp_ns for motion in self.streams.motions)

    def messages(self, cameras: Collection[int] | None = None) -> Iterator[recording_source.SensorMessage]:
        """See `Recording.messages`. With chosen camera frames, only the sweep nearest to each of them comes."""
        selected = [
            self.streams.camera[index] for index in recording_source.selected_indices(cameras, len(self.streams.camera))
        ]
        sweeps = self.streams.lidar
        motions = self.streams.motions
        if cameras is not None:
            sweeps = sorted({min(sweeps, key=lambda place: abs(place.stamp_ns - c.stamp_ns)) for c in selected})
            motions = [
                m
                for m in motions
                if any(abs(m.stamp_ns - c.stamp_ns) <= recording_source.MOTION_REACH_NS for c in selected)
            ]
        queue: list[tuple[int, int, int, bag_index.MessageLocation | EgoMotion]] = [
            (item.stamp_ns, kind, number, item)
            for kind, items in ((_EGO, motions), (_LIDAR, sweeps), (_CAMERA, selected))
            for number, item in enumerate(items)
        ]
        with self.storage.open() as reader:
            for *_, item in sorted(queue, key=lambda entry: entry[:3]):
                if isinstance(item, EgoMotion):
                    yield item
                    continue
                message = _load(self.storage, reader, item, self.clouds)
                yield self._from_origin(message) if isinstance(message, LidarFrame) else message

    def _from_origin(self, cloud: LidarFrame) -> LidarFrame:
        return measured_from(cloud, self.T_cloud_lidar, self.rig.lidar_frame, self.storage.path, _ADVICE)


def _streams(
    index: bag_index.BagIndex, reader: BagReader, camera: str, lidar: str, motion: tuple[tuple[str, str], str | None]
) -> PairStreams:
    """The streams of the pair. `motion`: the vehicle's frames, and the topic that was asked for."""
    frames, requested = motion
    motion_source = bag_index.motion_topic(index, reader, frames, requested)
    places = index.streams[motion_source].ordered() if motion_source in index.streams else []
    moved = (
        bag_index.motions_of_transforms(index, reader, motion_source, frames)
        if motion_source is not None and not places
        else ()
    )
    for topic in (camera, lidar):
        _require_stamps(index, topic)
    return PairStreams(index.streams[camera].ordered(), index.streams[lidar].ordered(), places, moved)


def _require_stamps(index: bag_index.BagIndex, topic: str) -> None:
    """Raises SourceError if all messages of a topic have one stamp."""
    stamps_ns = {place.stamp_ns for place in index.streams[topic].locations}
    count = len(index.streams[topic].locations)
    if count > 1 and len(stamps_ns) == 1:
        raise SourceError(
            f"{index.path}: all {count} messages on {topic} have the stamp {stamps_ns.pop()} ns in their header, so "
            "nothing says when each was measured: let the driver fill header.stamp, and record again (the time at "
            "which the recorder received a message is no replacement, it is milliseconds late)"
        )


def _frames(text: str | None) -> tuple[str, str]:
    if text is None:
        return bag_index.VEHICLE
    parent, comma, child = text.partition(",")
    if not (parent and comma and child):
        raise UsageError(
            f"moving={text}: give the frame in which the vehicle moves, and its own: moving=odom,base_link"
        )
    return parent, child


def _load(
    storage: BagStorage, reader: BagReader, place: bag_index.MessageLocation, clouds: bag_index.CloudDecoder
) -> recording_source.SensorMessage:
    data = reader.read(place.at)
    try:
        return clouds.decode(place.type_name, data)
    except DecodeError as error:
        raise SourceError(f"{storage.path}: the {place.type_name} of {place.stamp_ns} ns: {error}") from error


@dataclass(frozen=True, slots=True, order=True)
class _LoggedMessage:
    logged_ns: int
    at: tuple[int, ...]
    topic: str


@dataclass(frozen=True, slots=True, eq=False)
class BagTopics:
    """The topics of a bag that was read through once.

    Attributes:
        infos: the topics of CDR messages, in the order of their names.
    """

    name: str
    infos: dict[str, TopicInfo]
    _storage: BagStorage
    _places: tuple[_LoggedMessage, ...]

    def messages(self, topics: Collection[str]) -> Iterator[TopicMessage]:
        """The messages of these topics, in the order in which they were recorded, each loaded when it is its turn.

        Raises:
            SourceError: the file is no longer what it was.
        """
        with self._storage.open() as reader:
            for place in self._places:
                if place.topic in topics:
                    type_name = self.infos[place.topic].type_name
                    yield TopicMessage(place.logged_ns, place.topic, type_name, reader.read(place.at))


def open_topics(spec: recording_source.SourceSpec) -> BagTopics:
    """Opens the topics of a bag or of a recorded window.

    Raises:
        UsageError: the source is no bag, or has a query, which cannot choose topics.
        SourceError: the bag is cut off or damaged, or a topic has messages of two types.
    """
    if not recording_source.is_bag(spec):
        raise UsageError(f"{spec.text} is no bag")
    spec.only()
    storage = open_storage(spec.path)
    types: dict[str, str] = {}
    places: list[_LoggedMessage] = []
    for entry in storage.entries():
        if types.setdefault(entry.topic, entry.type_name) != entry.type_name:
            raise SourceError(f"{spec.path}: {entry.topic} has messages of several types")
        places.append(_LoggedMessage(entry.logged_ns, entry.place, entry.topic))
    places.sort()
    times_ns: defaultdict[str, list[int]] = defaultdict(list)
    for place in places:
        times_ns[place.topic].append(place.logged_ns)
    infos = {topic: _info(types[topic], times_ns[topic]) for topic in sorted(types)}
    return BagTopics(spec.path.name, infos, storage, tuple(places))


def _info(type_name: str, logged_ns: Sequence[int]) -> TopicInfo:
    """What is known of a topic, from the ascending times of its messages."""
    span_s = (logged_ns[-1] - logged_ns[0]) * 1e-9
    return TopicInfo(type_name, len(logged_ns), (len(logged_ns) - 1) / span_s if span_s > 0 else 0.0)
