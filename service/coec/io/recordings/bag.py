"""ROS 2 bags and windows that coec recorded, as the recording of one pair or as all their topics.

A bag is read through once for its index (`index`); each message is read again when it is its turn.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from coec.calibration.frames.lidar_origin import NO_SCAN_LINES, PERIOD_NS, ApparentOrigin, SeveralOrigins, from_origin
from coec.calibration.types import CameraFrame, EgoMotion, Frame, FramePair, LidarFrame, Matrix4, Recognition, Rig
from coec.config import CalibrationConfig
from coec.errors import DecodeError, SourceError, UsageError
from coec.io.mcap.windows import is_window, read_window
from coec.io.recordings import bag_index, bag_recognition, recording_source
from coec.io.recordings.bag_recognition import PairMessages, Sweep, lidar_frame_of, rig_of_bag
from coec.io.recordings.bag_storage import BagReader, BagStorage, open_storage
from coec.io.recordings.clocks import header_clock_text
from coec.io.recordings.cloud_files import measured_from
from coec.io.recordings.recording_source import CLOUD, IMAGE, KINDS, MOTION, RECORD, DamagedFrames, evenly_spread
from coec.io.ros import message_decoding, messages
from coec.io.ros.topics import TopicInfo, TopicMessage
from coec.io.ros.transforms import bare
from coec.io.video import MAX_PIXELS, VideoReader, VideoTrack

_EGO, _LIDAR, _CAMERA = 0, 1, 2
"""Order of messages with equal stamps, as in `sources.recording`."""


_ADVICE = {
    ApparentOrigin.cause: "Name the LiDAR's frame with ?lidar_frame=..., if /tf_static has it. If only some of the "
    "clouds look so, two LiDARs publish on the topic: let each have its own, and record again.",
    SeveralOrigins.cause: "Choose the topic of one LiDAR with ?points=..., or one by its number with ?lidar_source=N, "
    "if a field of the points tells it.",
}


KEYS = (
    "camera",
    "points",
    "odometry",
    "intrinsics",
    "camera_frame",
    "lidar_frame",
    "moving",
    "time",
    "lidar_source",
    "odometry_frame",
    "metadata",
)


def open_bag(spec: recording_source.SourceSpec) -> recording_source.RecordingSource:
    """`BAG[?camera=/TOPIC][&points=/TOPIC][&odometry=/TOPIC][&intrinsics=FILE or /TOPIC][&camera_frame=NAME]
    [&lidar_frame=NAME][&moving=PARENT,CHILD][&time=FIELD,UNIT[,BASE]][&lidar_source=N][&odometry_frame=NAME]
    [&metadata=FILE or /TOPIC]`, and the keys of `bag_recognition.Readings`.

    Without a query, a recorded window is opened as such. In any other bag:

    - Topics are found by their type if there is only one of that type.
    - Intrinsics come from the `CameraInfo` of the camera's frame (or of the topic `intrinsics`), or from a YAML file.
    - The extrinsic comes from that file, else from `/tf_static`, over any number of joints. `camera_frame` names the
      camera's frame if its images name another one, or the images of one camera if several publish on the topic.
    - If a driver gives points in another frame than the LiDAR's (`base_link`), `lidar_frame` names the LiDAR's frame,
      and the points are moved back to it along `/tf_static`.
    - If no topic gives a velocity, the motion comes from the transforms of `/tf` between the frames that `moving` names
      (default: `odom` and `base_link`), else the rotation from an IMU. If `/tf_static` does not lead to the frame of
      the motion, the motion is left out; `odometry_frame` names another frame for it.
    - `time` says how points are timed, if their values leave it open (see `config.PointTimeConfig`).
    - `lidar_source` chooses one LiDAR of a cloud of several (see `io.ros.point_clouds.SOURCE_FIELDS`).
    - `metadata` describes the LiDAR whose packets are read, if the bag does not, or has several.

    Raises:
        UsageError: unknown query key, or an invalid value.
        SourceError: no bag, cut off or damaged; no topic, or several, of a type; no intrinsics, no extrinsic.
        WindowError: a recorded window is damaged.
    """
    query = spec.only(*KEYS, *bag_recognition.READING_KEYS)
    if not query and spec.path.suffix == ".mcap" and is_window(spec.path):
        return _window_recording(spec.path)
    clouds, frames = (
        bag_index.CloudDecoder.from_query(query.get("time"), query.get("lidar_source")),
        _frames(query.get("moving")),
    )
    readings = bag_recognition.Readings.from_query(query)
    storage = open_storage(spec.path)
    index = bag_index.build_index(storage, clouds, query.get("metadata"))
    camera_topic = index.camera_topic(query.get("camera"))
    lidar_topic = index.lidar_topic(query.get("points"))
    for topic in (camera_topic, lidar_topic):
        index.require_stamps(topic)
    index.require_one_frame(camera_topic, query.get("camera_frame"), "camera_frame")
    index.require_one_frame(lidar_topic, query.get("lidar_frame"), "lidar_frame")
    with storage.open() as reader:
        streams, of_twists = _streams(
            index,
            reader,
            camera_topic,
            lidar_topic,
            (frames, query.get("odometry"), query.get("odometry_frame")),
            readings,
        )
        images = _Images(storage, reader, streams.video, index.damaged)

        def first(kind: str, places: Sequence[bag_index.MessageLocation]) -> Frame | None:
            loaded = ((kind, p.stamp_ns, partial(_load, storage, reader, p, clouds)) for p in places)
            return next(index.damaged.sound(loaded), None)

        camera = next(images.sound(streams.camera), None)
        cloud = first(CLOUD, [sweep.clouds[0] for sweep in streams.lidar])
        motion = streams.moved[0] if streams.moved else first(MOTION, streams.motion)
        of_images = None if streams.video is not None else _of_images(images.sound(_middle(streams.camera)))
        if not (
            isinstance(camera, CameraFrame) and isinstance(cloud, LidarFrame) and isinstance(motion, EgoMotion | None)
        ):
            raise SourceError(f"{spec.path}: {camera_topic} holds no images, or no motion on the topic named for it")
        of_transforms = index.connect(query.get("camera_frame", camera.frame_id), cloud.frame_id, reader)
    pair = PairMessages(camera_topic, camera, cloud, motion, query.get("intrinsics"), query.get("camera_frame"))
    rig, T_cloud_lidar, of_rig = _rig(index, pair, query)
    if motion is not None and any(one.code == MOTION_LEFT_OUT for one in of_rig):
        streams = replace(streams, motion=[], moved=())
    of_clocks = _of_clocks(index, (camera_topic, lidar_topic, streams.motion_topic), readings)
    recognitions = (
        *of_clocks,
        *_of_video(streams.video),
        *(() if of_images is None else (of_images,)),
        *index.streams[lidar_topic].notes,
        *of_transforms,
        *of_rig,
        *(() if of_twists is None else (of_twists,)),
    )
    name, start = f"{spec.path.name}{camera_topic}", rig.T_camera_lidar_nominal
    recording = BagRecording(
        name, rig, start, storage, streams, T_cloud_lidar, clouds, readings, recognitions, damaged=index.damaged
    )
    return recording.recognised()


MOTION_LEFT_OUT = "motion_frame_unconnected"
"""Code of the recognition that the motion is left out."""


def _rig(
    index: bag_index.BagIndex, pair: PairMessages, query: dict[str, str]
) -> tuple[Rig, Matrix4, tuple[Recognition, ...]]:
    """The rig of a pair, the pose of the LiDAR in the frame of its clouds (4, 4), and what was recognised."""
    lidar_frame, T_cloud_lidar = lidar_frame_of(index, pair.cloud, query.get("lidar_frame"))
    motion, unconnected = _connected(index, lidar_frame, pair.motion, query.get("odometry_frame"))
    sweep = from_origin(pair.cloud, T_cloud_lidar, lidar_frame)
    rig, recognised = rig_of_bag(index, replace(pair, cloud=sweep, motion=motion))
    return rig, T_cloud_lidar, (*recognised, *(() if unconnected is None else (unconnected,)))


def _connected(
    index: bag_index.BagIndex, lidar_frame: str, motion: EgoMotion | None, requested: str | None
) -> tuple[EgoMotion | None, Recognition | None]:
    """The motion, in the frame that was asked for; None if /tf_static does not connect its frame and the LiDAR's, and
    what to tell of that.

    Raises:
        SourceError: /tf_static does not connect the frame that was asked for.
    """
    if motion is None or index.transform(lidar_frame, requested or motion.frame_id) is not None:
        return motion if motion is None or requested is None else replace(motion, frame_id=requested), None
    if requested is not None:
        raise SourceError(f"{index.path}: /tf_static does not connect {requested!r} and {lidar_frame!r}")
    text = (
        f"The motion is that of the frame {motion.frame_id!a} (of an odometry, its child_frame_id, or without one the "
        f"frame of its header), which /tf_static does not connect with {lidar_frame!a}: it is left out, and nothing is "
        "compensated for motion. Record /tf_static of the whole vehicle, or name a frame with its axes: "
        f"?odometry_frame=NAME ({lidar_frame}: the motion is the LiDAR's own)."
    )
    return None, Recognition(MOTION_LEFT_OUT, text, "warn")


def _window_recording(path: Path) -> recording_source.FramewiseRecording:
    damaged = DamagedFrames()
    window, configuration = read_window(path, partial(damaged.add, RECORD))

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
        damaged=damaged,
    )


@dataclass(frozen=True, slots=True)
class PairStreams:
    """Places of a pair's messages, each ascending by stamp; `motion` may be empty.

    Attributes:
        moved: the motion itself, instead of `motion`, if it was taken from transforms; ascending by stamp.
        video: the packets of the camera, if its topic is one of video.
        motion_topic: where the motion comes from.
    """

    camera: list[bag_index.MessageLocation]
    lidar: list[Sweep]
    motion: list[bag_index.MessageLocation]
    moved: tuple[EgoMotion, ...] = ()
    video: VideoTrack | None = None
    motion_topic: str | None = None

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
        readings: what a person said of the bag.
        recognitions: what was recognised of the bag.
        compensated: instant for which the points were compensated before they were recorded; None: for none.
        damaged: what cannot be read, and is left out.
    """

    name: str
    rig: Rig
    T_camera_lidar_start: Matrix4
    storage: BagStorage
    streams: PairStreams
    T_cloud_lidar: Matrix4
    clouds: bag_index.CloudDecoder
    readings: bag_recognition.Readings
    recognitions: tuple[Recognition, ...] = ()
    compensated: str | None = None
    configuration: CalibrationConfig | None = None
    damaged: DamagedFrames = field(default_factory=DamagedFrames)

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

    def messages(self, cameras: Collection[int] | None = None, kinds: Collection[str] = KINDS) -> Iterator[Frame]:
        """See `Recording.messages`. With chosen camera frames, only the sweep nearest to each of them comes. The origin
        of the first sweep of each second is checked."""
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
            if KINDS[kind] in kinds
        ]
        checked: LidarFrame | None = None
        with self.storage.open() as reader:
            images = _Images(self.storage, reader, self.streams.video, self.damaged)

            def load(kind: int, item: bag_index.MessageLocation | EgoMotion) -> Frame:
                nonlocal checked
                if isinstance(item, EgoMotion) or kind == _EGO:
                    return self._motion(reader, item)
                if not isinstance(item, Sweep):
                    return images.load(item)
                if checked is not None and checked.stamp_ns // PERIOD_NS != item.stamp_ns // PERIOD_NS:
                    checked = None
                sweep = self._sweep(reader, item, checked)
                checked = checked or sweep
                return sweep

            ordered = sorted(queue, key=lambda entry: entry[:3])
            yield from self.damaged.sound(
                (KINDS[kind], stamp_ns, partial(load, kind, item)) for stamp_ns, kind, _, item in ordered
            )

    def sweeps(self, stamps_ns: Collection[int]) -> Iterator[LidarFrame]:
        """See `Recording.sweeps`."""
        places = [place for place in self.streams.lidar if place.stamp_ns in stamps_ns]
        with self.storage.open() as reader:
            yield from self.damaged.sound(
                (CLOUD, place.stamp_ns, partial(self._sweep, reader, place)) for place in places
            )

    def recognised(self) -> BagRecording:
        """The recording with its sweeps as their points show them: clouds that are parts of a turn are joined, and
        points that were compensated for motion already have one time.

        Raises:
            SourceError: a cloud cannot be read.
        """
        readings = self.readings
        with self.storage.open() as reader:

            def load(place: bag_index.MessageLocation) -> Iterator[LidarFrame]:
                with suppress(SourceError):  # it is told when it is used
                    yield self._cloud(reader, place)

            clouds = [cloud for sweep in self.streams.lidar for cloud in sweep.clouds]
            sweeps, of_clouds = bag_recognition.sweeps_of_clouds(clouds, load, readings.clouds)
            streams = _shifted(replace(self.streams, lidar=sweeps), readings)
            recording = replace(self, streams=streams, recognitions=(*self.recognitions, *of_clouds))
            if readings.rings is None and recording._is_unordered(reader):
                seen = (*recording.recognitions, NO_SCAN_LINES)
                recording = replace(recording, readings=replace(readings, rings=False), recognitions=seen)
            instant, of_points = readings.compensated, None
            if instant is None and sweeps:
                instant, of_points = recording._compensated(reader)
        recognitions = (*recording.recognitions, *(() if of_points is None else (of_points,)))
        return replace(recording, recognitions=recognitions, compensated=instant or None)

    def _is_unordered(self, reader: BagReader) -> bool:
        """Whether ring numbers are no scan lines, by two sweeps: to look for the cones of each takes time."""
        inspected = [*self._sampled(reader, 2)]
        return bool(inspected) and all(NO_SCAN_LINES in sweep.recognitions for sweep in inspected)

    def _compensated(self, reader: BagReader) -> tuple[str | None, Recognition | None]:
        """See `bag_recognition.compensated`, of some sweeps."""
        if not self.streams.motions:
            return None, None
        sampled = [*self._sampled(reader, bag_recognition.SAMPLED_SWEEPS)]
        near = [
            motion
            for motion in self.streams.motions
            if any(abs(motion.stamp_ns - s.stamp_ns) <= recording_source.MOTION_REACH_NS // 5 for s in sampled)
        ]
        loaded = self.damaged.sound((MOTION, place.stamp_ns, partial(self._motion, reader, place)) for place in near)
        known = [motion for motion in loaded if isinstance(motion, EgoMotion)]
        if not known:
            return None, None
        return bag_recognition.compensated(sampled, known, self.rig.T_lidar_ego)

    def _motion(self, reader: BagReader, motion: bag_index.MessageLocation | EgoMotion) -> Frame:
        return motion if isinstance(motion, EgoMotion) else _load(self.storage, reader, motion, self.clouds)

    def _sampled(self, reader: BagReader, count: int) -> Iterator[LidarFrame]:
        """Some sweeps, evenly selected, without damaged ones."""
        sweeps = self.streams.lidar
        selected = (sweeps[index] for index in evenly_spread(len(sweeps), count))
        return self.damaged.sound((CLOUD, place.stamp_ns, partial(self._sweep, reader, place)) for place in selected)

    def _cloud(self, reader: BagReader, place: bag_index.MessageLocation) -> LidarFrame:
        cloud = _load(self.storage, reader, place, self.clouds)
        if not isinstance(cloud, LidarFrame):
            raise SourceError(f"{self.storage.path}: the {place.type_name} of {place.stamp_ns} ns is no cloud")
        return cloud

    def _sweep(self, reader: BagReader, place: Sweep, checked: LidarFrame | None = None) -> LidarFrame:
        clouds = [self._cloud(reader, cloud) for cloud in place.clouds]
        middle_ns = clouds[len(clouds) // 2].stamp_ns
        sweep = replace(bag_recognition.joined(clouds, middle_ns), stamp_ns=place.stamp_ns)
        sweep = sweep if self.compensated is None else bag_recognition.as_compensated(sweep, self.compensated)
        if self.readings.rings is False:
            sweep = replace(sweep, ring=None)
        return measured_from(
            sweep,
            self.T_cloud_lidar,
            self.rig.lidar_frame,
            self.storage.path,
            _ADVICE,
            self.readings.rings is True,
            checked,
        )


def _shifted(streams: PairStreams, readings: bag_recognition.Readings) -> PairStreams:
    """The streams with their stamps corrected."""
    return replace(
        streams,
        camera=[replace(place, stamp_ns=place.stamp_ns + readings.camera_offset_ns) for place in streams.camera],
        lidar=[replace(place, stamp_ns=place.stamp_ns + readings.lidar_offset_ns) for place in streams.lidar],
    )


def _streams(
    index: bag_index.BagIndex,
    reader: BagReader,
    camera: str,
    lidar: str,
    motion: tuple[tuple[str, str], str | None, str | None],
    readings: bag_recognition.Readings,
) -> tuple[PairStreams, Recognition | None]:
    """The streams of the pair, each cloud a sweep, and what to tell of the motion. `motion`: the vehicle's frames, and
    the topic and the frame that were asked for."""
    frames, requested, moving_frame = motion
    motion_source = bag_index.motion_topic(index, reader, frames, requested)
    places = index.streams[motion_source].ordered() if motion_source in index.streams else []
    moved = (
        bag_index.motions_of_transforms(index, reader, motion_source, frames)
        if motion_source is not None and not places
        else ()
    )
    for topic in (camera, lidar):
        _require_stamps(index, topic)
    of_twists = None
    if places and motion_source is not None:
        places = bag_recognition.motions_of_one_frame(reader, places, motion_source, moving_frame)
    if places and places[0].type_name == messages.ODOMETRY:
        by_poses, of_twists = bag_recognition.motion_of_odometry(reader, places, readings.motion)
        places, moved = (places, moved) if by_poses is None else ([], by_poses)
    sweeps = [
        Sweep(place.stamp_ns, place.at, place.type_name, clouds=(place,)) for place in index.streams[lidar].ordered()
    ]
    images = index.streams[camera]
    # One frame is left, see `require_one_frame`.
    video = images.videos.get(bare(images.locations[0].frame_id))
    return PairStreams(images.ordered(), sweeps, places, moved, video, motion_source), of_twists


def _of_clocks(
    index: bag_index.BagIndex, topics: Sequence[str | None], readings: bag_recognition.Readings
) -> tuple[Recognition, ...]:
    """What to tell of the clocks in the headers on the topics of camera, LiDAR and motion."""
    offsets_ns = (readings.camera_offset_ns, readings.lidar_offset_ns, 0)
    known = {topic: index.streams[topic] for topic in topics if topic is not None and topic in index.streams}
    shifts_s = {topic: 1e-9 * offset_ns for topic, offset_ns in zip(topics, offsets_ns, strict=True)}
    lags_s = {topic: (np.array(stream.lags_s) - shifts_s[topic]).tolist() for topic, stream in known.items()}
    firsts_s = {topic: 1e-9 * stream.locations[0].stamp_ns for topic, stream in known.items()}
    text = header_clock_text(lags_s, firsts_s)
    return (Recognition("header_clock", f"By the times of receipt, {text}.", "warn"),) if text else ()


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


class _Images:
    """Loads the images of a topic, each a message, or a packet of video."""

    def __init__(
        self, storage: BagStorage, reader: BagReader, video: VideoTrack | None, damaged: DamagedFrames
    ) -> None:
        self._storage, self._reader, self._damaged = storage, reader, damaged
        self._video = None if video is None else VideoReader(video, self._packet, bag_index.LIMITS)
        self._type_name = ""

    def sound(self, places: Iterable[bag_index.MessageLocation]) -> Iterator[Frame]:
        """The images of these places, without damaged ones."""
        return self._damaged.sound((IMAGE, place.stamp_ns, partial(self.load, place)) for place in places)

    def load(self, place: bag_index.MessageLocation) -> Frame:
        """The image of a message, with the stamp of its place.

        Raises:
            SourceError: the message holds no image, or its picture cannot be decoded.
        """
        if self._video is None:
            frame = _load(self._storage, self._reader, place, bag_index.CloudDecoder())
            return replace(frame, stamp_ns=place.stamp_ns) if isinstance(frame, CameraFrame) else frame
        self._type_name = place.type_name
        try:
            image = self._video.picture(place.at)
        except DecodeError as error:
            raise SourceError(f"{self._storage.path}: the video at {place.stamp_ns} ns: {error}") from error
        if image is None:
            raise SourceError(
                f"{self._storage.path}: the picture of the video at {place.stamp_ns} ns cannot be decoded: it is "
                f"damaged, or larger than {MAX_PIXELS} pixels"
            )
        return CameraFrame(place.stamp_ns, place.frame_id, image)

    def _packet(self, at: tuple[int, ...]) -> bytes:
        video = message_decoding.video_data(self._type_name, self._reader(at))
        return b"" if video is None else video[1]


def _middle(places: Sequence[bag_index.MessageLocation]) -> Sequence[bag_index.MessageLocation]:
    """Some in a row, in the middle of a recording."""
    begin = max(0, (len(places) - bag_recognition.COMPARED_IMAGES) // 2)
    return places[begin : begin + bag_recognition.COMPARED_IMAGES]


def _of_images(images: Iterable[Frame]) -> Recognition | None:
    """What to tell of images in a row."""
    try:
        return bag_recognition.alternating_cameras([one for one in images if isinstance(one, CameraFrame)])
    except (DecodeError, SourceError):
        return None  # it is reported when it is used


def _of_video(video: VideoTrack | None) -> tuple[Recognition, ...]:
    """What to tell of pictures that were left out."""
    if video is None or not video.left_out:
        return ()
    text = (
        f"Of the video, {bag_index.video_left_out(video)} cannot be decoded and are left out, beside "
        f"{len(video.packets)} that can: let the encoder send a key frame each second (FFmpeg: gop_size), and record "
        "without loss (larger caches, reliable QoS)."
    )
    return (Recognition("video_left_out", text, "warn"),)


def _load(
    storage: BagStorage, reader: BagReader, place: bag_index.MessageLocation, clouds: bag_index.CloudDecoder
) -> Frame:
    try:
        return clouds.load(reader, place)
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
                    yield TopicMessage(place.logged_ns, place.topic, type_name, reader(place.at))


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
        if not entry.data:
            continue
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
