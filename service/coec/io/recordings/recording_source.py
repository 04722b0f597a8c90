"""The interface of a recording, whatever its layout on disk: its rig, and its frames in the order of sensor time; and
the grammar of a SOURCE argument, `[layout:]path[?key=value&…]`.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar, runtime_checkable
from urllib.parse import parse_qsl

import numpy as np

from coec.calibration.types import CameraFrame, EgoMotion, Frame, LidarFrame, Matrix4, Recognition, Rig
from coec.config import CalibrationConfig
from coec.errors import CoecError, DecodeError, MisreadError, SourceError, UsageError
from coec.extensions import SOURCES, added_by_packages
from coec.io.recordings.clocks import STAMPS_IRREGULAR, irregular_stamps_text
from coec.io.user_files import expand_home

MOTION_REACH_NS = 1_000_000_000
"""Ego-motion within this time of a chosen camera frame is handed out with it, ns: five times the default motion
tolerance."""

_EGO, _LIDAR, _CAMERA = 0, 1, 2
"""Order of messages with equal stamps, so that the partners of a camera frame come before it."""

F = TypeVar("F", bound=Frame)

IMAGE, CLOUD, MOTION, RECORD = "image", "cloud", "motion", "record"
KINDS: Final = (MOTION, CLOUD, IMAGE)
"""What may be damaged: frames by their kind, in the order of the numbers above, and records of the container."""

ALL_DAMAGED: Final = 64
"""After so many damaged frames of a kind without a sound one, all are taken to be like the first."""


@dataclass(slots=True)
class DamagedFrames:
    """What of a recording cannot be read, and is left out. Each place counts once, however often it is met."""

    _causes: dict[tuple[str, object], str] = field(default_factory=dict)
    _first: str = ""

    def add(self, kind: str, place: object, error: CoecError) -> None:
        """Notes what `kind` at a place of the recording (a stamp, a byte) cannot be read for."""
        refused = error if isinstance(error, DecodeError) else error.__cause__
        cause = refused.reason if isinstance(refused, DecodeError) else f"{kind}_unreadable"
        self._causes.setdefault((kind, place), cause)
        self._first = self._first or str(error)

    def sound(self, frames: Iterable[tuple[str, int, Callable[[], F]]]) -> Iterator[F]:
        """The frames that can be read, of (kind, stamp, function that loads it).

        Raises:
            SourceError: no frame of a kind can be read; or one was misread, so that all are.
        """
        read: Counter[str] = Counter()
        refused: Counter[str] = Counter()
        first: dict[str, SourceError] = {}
        for kind, stamp_ns, load in frames:
            try:
                frame = load()
            except MisreadError:
                raise
            except SourceError as error:
                self.add(kind, stamp_ns, error)
                first.setdefault(kind, error)
                refused[kind] += 1
                if not read[kind] and refused[kind] == ALL_DAMAGED:
                    break
                continue
            read[kind] += 1
            yield frame
        for kind, one in first.items():
            if not read[kind] and kind != MOTION:
                count = refused[kind]
                raise one if count == 1 else SourceError(f"none of {count} {kind}s can be read; the first: {one}")

    def __len__(self) -> int:
        """How many frames and records are damaged."""
        return len(self._causes)

    @property
    def text(self) -> str:
        """How many frames are damaged, by cause; and the first of them, with its place."""
        causes = Counter(self._causes.values())
        counts = ", ".join(f"{count} {cause}" for cause, count in sorted(causes.items()))
        return f"{len(self._causes)} damaged ({counts}); the first: {self._first}"

    @property
    def recognitions(self) -> tuple[Recognition, ...]:
        """What to tell; empty if nothing is damaged."""
        if not self._causes:
            return ()
        text = (
            f"Frames or records are left out, {self.text}. If there are many, copy the recording again, or check the "
            "disk that it was recorded on."
        )
        return (Recognition("damaged_frames", text, "warn"),)


class RecordingSource(Protocol):
    """A recorded drive of one camera-LiDAR pair."""

    @property
    def name(self) -> str:
        """Layout, drive and camera, for people to read."""

    @property
    def rig(self) -> Rig:
        """Rig of the pair, with the calibration that came with the recording as nominal."""

    @property
    def T_camera_lidar_start(self) -> Matrix4:
        """(4, 4) extrinsic that was current when the recording was made; the nominal one if that was not recorded."""

    @property
    def configuration(self) -> CalibrationConfig | None:
        """Configuration that a recorded window carries; None for every other recording."""

    @property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames, ascending, nanoseconds."""

    @property
    def sweep_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the sweeps, ascending, nanoseconds."""

    @property
    def motion_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the ego-motion, ascending, nanoseconds; empty if there is none."""

    def messages(self, cameras: Collection[int] | None = None, kinds: Collection[str] = KINDS) -> Iterator[Frame]:
        """Messages in ascending order of their stamps, each loaded when it is its turn.

        Args:
            cameras: indices into `camera_stamps_ns`: only these camera frames, and the sweeps and ego-motion that are
                needed to pair them. None: everything.
            kinds: only messages of these `KINDS` are loaded.

        Raises:
            UsageError: an index is out of range.
            SourceError: a file cannot be read; names it.
        """

    def sweeps(self, stamps_ns: Collection[int]) -> Iterator[LidarFrame]:
        """The sweeps of some of `sweep_stamps_ns`, ascending; damaged ones are left out.

        Raises:
            SourceError: a file cannot be read, or no sweep of several can; names it.
        """
        ...


@runtime_checkable
class HasGroundTruth(Protocol):
    """A recording whose true extrinsic is known, because it was simulated."""

    def truth(self, stamp_ns: int) -> Matrix4:
        """True T_camera_lidar (4, 4) at a time."""


@runtime_checkable
class HasRecognitions(Protocol):
    """A recording whose layout was recognised, from its values, when it was opened."""

    @property
    def recognitions(self) -> tuple[Recognition, ...]:
        """What was recognised of the recording as a whole; sweeps have their own."""

    @property
    def damaged(self) -> DamagedFrames:
        """What has been found damaged so far."""


def recognitions_of(recording: RecordingSource, sweeps: Iterable[LidarFrame]) -> tuple[Recognition, ...]:
    """What was recognised of a recording and of these sweeps of it, each once."""
    whole = recording.recognitions if isinstance(recording, HasRecognitions) else ()
    stamps_ns = {"camera": recording.camera_stamps_ns, "LiDAR": recording.sweep_stamps_ns}
    irregular = irregular_stamps_text(stamps_ns) if recording.configuration is None else ""
    whole = (
        *whole,
        *damaged_of(recording).recognitions,
        *((Recognition(STAMPS_IRREGULAR, irregular, "warn"),) if irregular else ()),
    )
    return tuple({one.code: one for one in (*whole, *(one for sweep in sweeps for one in sweep.recognitions))}.values())


def damaged_of(recording: RecordingSource) -> DamagedFrames:
    """What has been found damaged of a recording so far."""
    return recording.damaged if isinstance(recording, HasRecognitions) else DamagedFrames()


@dataclass(frozen=True, slots=True, eq=False)
class RecordedFrame:
    """A camera frame and the sweep that was taken with it, not loaded yet."""

    camera_stamp_ns: int
    load_camera: Callable[[], CameraFrame]
    lidar_stamp_ns: int
    load_lidar: Callable[[], LidarFrame]


@dataclass(frozen=True, slots=True, eq=False)
class FramewiseRecording:
    """A `Recording` of layouts that number camera frames and sweeps together (KITTI, manifests, windows).

    Attributes:
        frames: the frames, ascending by `camera_stamp_ns`.
        motions: the ego-motion, ascending by `stamp_ns`.
        recognitions, damaged: see `HasRecognitions`.
    """

    name: str
    rig: Rig
    T_camera_lidar_start: Matrix4
    frames: tuple[RecordedFrame, ...]
    motions: tuple[EgoMotion, ...] = ()
    configuration: CalibrationConfig | None = None
    recognitions: tuple[Recognition, ...] = ()
    damaged: DamagedFrames = field(default_factory=DamagedFrames)

    @property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames, ascending, nanoseconds."""
        return tuple(frame.camera_stamp_ns for frame in self.frames)

    @property
    def sweep_stamps_ns(self) -> tuple[int, ...]:
        """See `Recording`."""
        return tuple(sorted({frame.lidar_stamp_ns for frame in self.frames}))

    @property
    def motion_stamps_ns(self) -> tuple[int, ...]:
        """See `Recording`."""
        return tuple(motion.stamp_ns for motion in self.motions)

    def messages(self, cameras: Collection[int] | None = None, kinds: Collection[str] = KINDS) -> Iterator[Frame]:
        """See `Recording.messages`."""
        frames = [self.frames[index] for index in selected_indices(cameras, len(self.frames))]
        stamps_ns = [frame.camera_stamp_ns for frame in frames]
        motions = self.motions if cameras is None else motions_near(self.motions, stamps_ns)
        queue: list[tuple[int, int, int, Callable[[], Frame]]] = []
        for place, frame in enumerate(frames):
            queue.append((frame.lidar_stamp_ns, _LIDAR, place, frame.load_lidar))
            queue.append((frame.camera_stamp_ns, _CAMERA, place, frame.load_camera))
        for place, motion in enumerate(motions):
            queue.append((motion.stamp_ns, _EGO, place, lambda motion=motion: motion))  # type: ignore[misc]
        ordered = sorted((entry for entry in queue if KINDS[entry[1]] in kinds), key=lambda entry: entry[:3])
        yield from self.damaged.sound((KINDS[kind], stamp_ns, load) for stamp_ns, kind, _, load in ordered)

    def sweeps(self, stamps_ns: Collection[int]) -> Iterator[LidarFrame]:
        """See `Recording.sweeps`."""
        places = {frame.lidar_stamp_ns: frame.load_lidar for frame in self.frames if frame.lidar_stamp_ns in stamps_ns}
        yield from self.damaged.sound((CLOUD, stamp_ns, places[stamp_ns]) for stamp_ns in sorted(places))


def selected_indices(cameras: Collection[int] | None, count: int) -> list[int]:
    """The indices asked for, ascending and once each; None asks for all.

    Raises:
        UsageError: an index is outside 0 ... count - 1.
    """
    if cameras is None:
        return list(range(count))
    for index in cameras:
        if not 0 <= index < count:
            raise UsageError(f"there is no camera frame {index}: the recording has {count}, counted from 0")
    return sorted(set(cameras))


def evenly_spread(count: int, limit: int) -> list[int]:
    """At most `limit` of `count` indices, evenly spread. They include the first and the last; a single one is the
    first."""
    if limit >= count:
        return list(range(count))
    return sorted({round(index) for index in np.linspace(0, count - 1, limit)})


def motions_near(motions: Collection[EgoMotion], stamps_ns: Collection[int]) -> list[EgoMotion]:
    """The ego-motion samples within `MOTION_REACH_NS` of any of the stamps, in their order."""
    return [m for m in motions if any(abs(m.stamp_ns - stamp) <= MOTION_REACH_NS for stamp in stamps_ns)]


FORMS = """accepted forms of a source:
  FILE.mcap                                     a recorded window
  BAG?camera=/TOPIC&points=/TOPIC&...           any bag of ROS 2 or ROS 1: FILE.mcap, FILE.db3, FILE.bag or a folder of
                                                them (topics are found by type where they are unique;
                                                lidar_frame=NAME for clouds in another,
                                                camera_frame=NAME for images that name another,
                                                moving=PARENT,CHILD for motion on /tf, time=FIELD,UNIT[,BASE],
                                                lidar_source=N for one LiDAR of a cloud of several; rings=,
                                                compensated=, clouds_per_sweep=, motion=, odometry_frame=,
                                                camera_offset=, lidar_offset= where `coec check` names them)
  kitti360:ROOT?drive=...&camera=image_00       KITTI-360 in its official folders
  kitti-raw:ROOT?drive=...&camera=image_02      KITTI raw in its official folders, or one drive with its calib_*.txt
  kitti-odometry:SEQUENCE?camera=image_2        one sequence of KITTI's odometry benchmark
  FOLDER or dataset.yaml                        images and clouds listed in a manifest
  sim:seed=1&seconds=60&camera=fisheye700&...   a seeded drive through a town that does not exist (needs coec-lab)
  sim:rig=four-fisheyes&pair=front-roof&...     one pair of a simulated rig"""

LAYOUTS = ("kitti360", "kitti-raw", "kitti-odometry", "sim")

BAG_SUFFIXES = (".mcap", ".db3", ".bag")
"""Suffixes of the files of bags."""


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """A parsed SOURCE: its layout (None for a plain path), its path and its query."""

    text: str
    layout: str | None
    path: Path
    query: dict[str, str] = field(default_factory=dict)

    def only(self, *keys: str) -> dict[str, str]:
        """The query, checked to hold no other keys than these.

        Raises:
            UsageError: names the unknown keys and the known ones.
        """
        unknown = sorted(set(self.query) - set(keys))
        if unknown:
            known = f"known here: {', '.join(keys)}" if keys else "this kind of source takes none"
            raise UsageError(f"unknown query key {', '.join(unknown)} in {self.text}; {known}", FORMS)
        return self.query


def installed_layout(name: str) -> Any:
    """The module that reads sources of the form `NAME:...`, found by the entry points of group `coec.sources`. It has
    `open_recording(query)`, `open_lidars(query, a, b)` and `open_played_rig(query)`.

    Raises:
        UsageError: no installed package reads such sources.
    """
    load = added_by_packages(SOURCES).get(name)
    if load is not None:
        return load()
    raise UsageError(f"sources of the form `{name}:` come with the laboratory: `pip install coec-lab`")


def parse_spec(text: str) -> SourceSpec:
    """Splits a SOURCE argument.

    Raises:
        UsageError: an unknown layout, a malformed query or a missing path; lists the accepted forms.
    """
    prefix, colon, rest = text.partition(":")
    layout = prefix if colon and prefix in LAYOUTS else None
    if layout is None and colon and "/" not in prefix and "." not in prefix:
        raise UsageError(f"unknown source layout {prefix!r} in {text}", FORMS)
    # A simulated drive has no path, so the question mark may be left out.
    place = f"?{rest.removeprefix('?')}" if layout == "sim" else rest if layout else text
    location, _, query = place.partition("?")
    if not location and layout != "sim":
        raise UsageError(f"no path in source {text!r}", FORMS)
    return SourceSpec(text, layout, expand_home(location), _parse_query(query, text))


def is_bag(spec: SourceSpec) -> bool:
    """Whether the source is a bag or a recorded window, by the name of the file or the content of the folder: with a
    `metadata.yaml`, or with files of bags and without a `dataset.yaml`."""
    path = spec.path
    if spec.layout is not None or not path.is_dir():
        return spec.layout is None and path.suffix in BAG_SUFFIXES
    if (path / "metadata.yaml").is_file():
        return True
    with suppress(OSError):
        return not (path / "dataset.yaml").is_file() and any(file.suffix in BAG_SUFFIXES for file in path.iterdir())
    return False


def is_rig(spec: SourceSpec) -> bool:
    """Whether the source is a whole simulated rig, not one pair of it."""
    return spec.layout == "sim" and "rig" in spec.query and "pair" not in spec.query


def _parse_query(query: str, text: str) -> dict[str, str]:
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise UsageError(f"malformed query in source {text}: {error}", FORMS) from error
    result: dict[str, str] = {}
    for key, value in pairs:
        if key in result:
            raise UsageError(f"query key {key} given twice in source {text}")
        if not value:
            raise UsageError(f"query key {key} has no value in source {text}")
        result[key] = value
    return result
