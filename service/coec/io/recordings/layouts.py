"""Recordings as input: `open_source` opens the recording of a pair in every layout, `open_lidars` the sweeps of two
LiDARs.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from coec.calibration.rig.lidar_sampling import LidarRig, SweepPair
from coec.calibration.types import EgoMotion, LidarFrame, Matrix4
from coec.errors import DecodeError, SourceError, UsageError
from coec.io.recordings.bag_index import CLOUD_TYPES, VELOCITY_TYPES, CloudDecoder, MessageLocation, build_index
from coec.io.recordings.bag_storage import BagStorage, open_storage
from coec.io.recordings.recording_source import (
    FORMS,
    MOTION_REACH_NS,
    RecordingSource,
    SourceSpec,
    installed_layout,
    is_bag,
    is_rig,
    parse_spec,
)
from coec.io.ros.transforms import bare

__all__ = ["RecordingSource", "open_source"]


def open_source(spec: str) -> RecordingSource:
    """Opens the recording that a SOURCE argument names (CONTRACT, "Command line"). Frames are loaded later.

    Raises:
        UsageError: the argument does not fit the grammar, or its query has an unknown key.
        SourceError: the recording is absent, incomplete or not in the layout that its name promises.
        WindowError: a recorded window is damaged.
    """
    parsed = parse_spec(spec)
    # Each layout is imported when it is asked for, because not all need OpenCV, rosbags and the MCAP readers.
    match parsed.layout:
        case "kitti360":
            from coec.io.recordings.kitti import open_kitti360

            return open_kitti360(parsed)
        case "kitti-raw":
            from coec.io.recordings.kitti import open_kitti_raw

            return open_kitti_raw(parsed)
        case "kitti-odometry":
            from coec.io.recordings.kitti import open_kitti_odometry

            return open_kitti_odometry(parsed)
        case "sim":
            source: RecordingSource = installed_layout("sim").open_recording(parsed.query)
            return source
    return _open_path(parsed)


def _open_path(spec: SourceSpec) -> RecordingSource:
    if not spec.path.exists():
        is_name = len(spec.path.parts) == 1 and not spec.path.suffix  # it may be meant as another form
        raise SourceError(f"{spec.path} does not exist", *([FORMS] if is_name else []))
    if is_bag(spec):
        from coec.io.recordings.bag import open_bag

        return open_bag(spec)
    from coec.io.recordings.kitti import is_kitti_odometry, open_kitti_odometry

    if is_kitti_odometry(spec.path) and not (spec.path / "dataset.yaml").is_file():
        return open_kitti_odometry(spec)
    if spec.path.is_dir() or spec.path.suffix in (".yaml", ".yml"):
        from coec.io.recordings.manifest import open_manifest

        return open_manifest(spec)
    raise UsageError(f"{spec.path} is neither a folder nor an .mcap, .db3, .bag, .yaml or .yml file", FORMS)


MAX_STAMP_DIFFERENCE_NS = 60_000_000
"""Two sweeps are a pair if their stamps differ by at most this, ns: a little more than half a turn at 10 Hz."""


@dataclass(frozen=True, slots=True)
class FrameStream:
    """The frames of one stream: ascending stamps, and a function that loads the frame at an index when it is needed."""

    stamps_ns: tuple[int, ...]
    load: Callable[[int], LidarFrame | EgoMotion]


@dataclass(frozen=True, slots=True, eq=False)
class LidarRecording:
    """Sweeps of two LiDARs, and ego-motion.

    Attributes:
        name: name for people to read.
        truth: true T_a_b (4, 4) at a time; None if it is unknown.
    """

    name: str
    rig: LidarRig
    a: FrameStream
    b: FrameStream
    motion: FrameStream
    truth: Callable[[int], Matrix4] | None = None

    def pairs(self, count: int) -> list[SweepPair]:
        """At most `count` pairs, evenly spread over the recording.

        Raises:
            SourceError: a frame cannot be read, or no sweep of one LiDAR is near a sweep of the other.
        """
        near = [
            (i, j)
            for i, stamp in enumerate(self.a.stamps_ns)
            if (j := _nearest(self.b, stamp, MAX_STAMP_DIFFERENCE_NS)) is not None
        ]
        if not near:
            raise SourceError(
                f"{self.name}: no sweep of {self.rig.a} within {MAX_STAMP_DIFFERENCE_NS / 1e6:g} ms of one of "
                f"{self.rig.b}"
            )
        selected = sorted({round(place) for place in np.linspace(0, len(near) - 1, count)})
        return [self._pair(*near[place]) for place in selected]

    def _pair(self, i: int, j: int) -> SweepPair:
        a, b = self.a.load(i), self.b.load(j)
        assert isinstance(a, LidarFrame)
        assert isinstance(b, LidarFrame)
        k = _nearest(self.motion, a.stamp_ns, MOTION_REACH_NS // 5)
        motion = None if k is None else self.motion.load(k)
        assert not isinstance(motion, LidarFrame)
        return SweepPair(a, b, motion)


def open_lidars(source: str, a: str, b: str) -> LidarRecording:
    """Opens the LiDARs `a` and `b` of `sim:rig=...` (names of sensors) or of a bag (topics).

    Raises:
        UsageError: another kind of source, or no such sensor.
        SourceError: the bag is absent or damaged, has no such topic, or does not give the poses of the LiDARs.
    """
    if a == b:
        raise UsageError(f"{a} is named twice: name two LiDARs")
    spec = parse_spec(source)
    if is_rig(spec):
        recording: LidarRecording = installed_layout("sim").open_lidars(spec.query, a, b)
        return recording
    if is_bag(spec):
        return lidars_of_bag(spec, a, b)
    raise UsageError(f"{source} has no two LiDARs: give a bag, or sim:rig=four-fisheyes&... without `pair`")


def _nearest(frames: FrameStream, stamp_ns: int, within_ns: int) -> int | None:
    """Index of the frame nearest to a stamp; None if none is near enough."""
    if not frames.stamps_ns:
        return None
    differences_ns = np.abs(np.array(frames.stamps_ns, np.int64) - stamp_ns)
    place = int(differences_ns.argmin())
    return place if differences_ns[place] <= within_ns else None


AS_THEY_ARE = CloudDecoder()


def lidars_of_bag(spec: SourceSpec, a: str, b: str) -> LidarRecording:
    """Opens `BAG[?odometry=/TOPIC]`. `a` and `b` are topics of clouds; the poses come from `/tf_static`.

    Raises:
        UsageError: an unknown query key.
        SourceError: no bag, no such topic, a damaged message, or no transform between the two LiDARs.
    """
    query = spec.only("odometry")
    storage = open_storage(spec.path)
    index = build_index(storage, AS_THEY_ARE)
    places = {topic: index.streams[index.topic(CLOUD_TYPES, topic, "points")].ordered() for topic in (a, b)}
    first = {topic: _load(storage, places[topic][0]) for topic in (a, b)}
    odometry = index.optional_topic(VELOCITY_TYPES, query.get("odometry"), "odometry")
    motions = index.streams[odometry].ordered() if odometry is not None else []
    frame_a, frame_b = (bare(first[topic].frame_id) for topic in (a, b))
    T_a_b = index.transform(frame_a, frame_b)
    if T_a_b is None:
        raise SourceError(f"{spec.path}: /tf_static does not connect {frame_a!r} and {frame_b!r}")
    T_a_ego = index.transform(frame_a, _load(storage, motions[0]).frame_id) if motions else None
    if T_a_ego is None:
        T_a_ego, motions = np.eye(4), []  # motion is of no use without its pose against the LiDARs

    def frames(of: list[MessageLocation]) -> FrameStream:
        return FrameStream(tuple(place.stamp_ns for place in of), lambda number: _load(storage, of[number]))

    return LidarRecording(
        spec.path.name, LidarRig(a, b, T_a_b, T_a_ego), frames(places[a]), frames(places[b]), frames(motions)
    )


def _load(storage: BagStorage, place: MessageLocation) -> LidarFrame | EgoMotion:
    try:
        with storage.open() as reader:
            frame = AS_THEY_ARE.load(reader, place)
    except DecodeError as error:
        raise SourceError(f"{storage.path}: the {place.type_name} of {place.stamp_ns} ns: {error}") from error
    if not isinstance(frame, LidarFrame | EgoMotion):
        raise SourceError(f"{storage.path}: the {place.type_name} of {place.stamp_ns} ns is neither a cloud nor motion")
    return frame
