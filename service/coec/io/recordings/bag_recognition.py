"""What the messages of a bag show of how they are meant: the velocities of an odometry, clouds that are parts of a
turn, points that were compensated for motion before they were recorded; and the rig of a pair, with intrinsics from
a `CameraInfo` or a file, and the extrinsic along the transforms of the bag between the frames that its messages
name. Where two frames do not agree by name, the frame is recognised; what was recognised, left out or overridden is
reported.

A person can say otherwise in the query of the bag; every recognition names the key.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError, model_validator

from coec.calibration.frames import evidence, message_evidence
from coec.calibration.frames.pairing import motion_at
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, Matrix4, Recognition, Rig
from coec.config import CameraIntrinsics, FilePath, Matrix4x4, describe
from coec.config.model import ConfigModel
from coec.config.pair import with_direction
from coec.errors import ConfigError, DecodeError, SourceError, UsageError
from coec.geometry.projection import share_in_image
from coec.io.frame_validation import MAX_SPEED
from coec.io.images import decode_grey_reduced
from coec.io.intrinsics_files import load_camera_document, with_camera
from coec.io.recordings.bag_index import FEW, LIMITS, LISTED, BagIndex, MessageLocation
from coec.io.recordings.bag_storage import METADATA, BagReader
from coec.io.recordings.recording_source import MOTION_REACH_NS, evenly_spread
from coec.io.rig_files import camera_of, load_mask, rigid_matrix
from coec.io.ros import camera_info, message_decoding, messages
from coec.io.ros.transforms import bare, odometry_pose
from coec.io.user_files import expand_home

MAX_OFFSET_S: Final = 1e10
"""Largest correction of stamps, s: from nanoseconds since 1970 that were read as seconds nothing can be corrected."""

SAMPLED_MOVES, MOST_BETWEEN = 40, 256
"""Messages of an odometry whose poses and velocities are compared, evenly selected, and the most that follow each up to
the next pose that is far enough from it."""

FEW_CLOUDS: Final = 5
"""Clouds that are looked at before a doubt."""

OVERLAPPING: Final = 1.3
"""Parts of one turn last no longer than so many times their distance; clouds of two LiDARs overlap in time."""

OVERLAPPING_SHARE, SHORTER = 0.4, 1.8
"""Two LiDARs that come in turn have half of their intervals shorter than a cloud lasts, also where a recording has
gaps: at least the first share of them, by at least the second factor. Stamps of one that scatter by a fifth of a sweep
have one in twenty."""

TWIST_CONTRADICTED: Final = "twist_contradicted"
"""Code of the recognition that velocities and poses of an odometry fit in no way."""

Value = TypeVar("Value")

SAMPLED_SWEEPS: Final = 6
"""Sweeps that are looked at for compensation."""

GAP: Final = 1.8
"""Clouds that are parts of one turn follow each other; a gap of so many median intervals, as where one was lost, ends a
turn."""


@dataclass(frozen=True, slots=True)
class Readings:
    """What a person says of a bag; None: it is recognised.

    Attributes:
        rings: whether ring numbers are scan lines.
        compensated: the instant for which points were compensated, see `evidence`; empty: for none.
        clouds: how many clouds make a sweep.
        motion: `twist` or `pose`: from what of an odometry the motion comes.
        camera_offset_ns, lidar_offset_ns: added to the stamps.
    """

    rings: bool | None = None
    compensated: str | None = None
    clouds: int | None = None
    motion: str | None = None
    camera_offset_ns: int = 0
    lidar_offset_ns: int = 0

    @classmethod
    def from_query(cls, query: dict[str, str]) -> Readings:
        """From the keys of a query; others are ignored.

        Raises:
            UsageError: a value does not fit.
        """
        return cls(
            _value(query, "rings", {"lines": True, "none": False}),
            _value(query, "compensated", {"no": "", **{name: name for name in ("stamp", "begin", "middle", "end")}}),
            _value(
                query, "clouds_per_sweep", {str(count): count for count in range(1, message_evidence.MOST_CLOUDS + 1)}
            ),
            _value(query, "motion", {"twist": "twist", "pose": "pose"}),
            _offset_ns(query, "camera_offset"),
            _offset_ns(query, "lidar_offset"),
        )


READING_KEYS: Final = ("rings", "compensated", "clouds_per_sweep", "motion", "camera_offset", "lidar_offset")
"""The keys that `Readings` reads."""


def _value(query: dict[str, str], key: str, values: dict[str, Value]) -> Value | None:
    if key not in query:
        return None
    if query[key] not in values:
        names = list(values)
        accepted = ", ".join(names) if len(names) < message_evidence.MOST_CLOUDS else f"{names[0]} to {names[-1]}"
        raise UsageError(f"{key}={query[key]}: it is one of {accepted}")
    return values[query[key]]


def _offset_ns(query: dict[str, str], key: str) -> int:
    try:
        offset_s = float(query.get(key, "0"))
    except ValueError:
        offset_s = float("nan")
    if not abs(offset_s) <= MAX_OFFSET_S:
        raise UsageError(f"{key}={query[key]}: seconds that are added to the stamps, as {key}=-0.03")
    return round(offset_s * 1e9)


COMPARED_IMAGES: Final = 9
"""Images in a row whose likeness is compared."""

ALTERNATING, UNLIKE = 0.6, 0.3
"""Images of one camera are the less alike the longer the time between them: those of several differ by less than the
first share of what neighbours do, which is at least the second, in standard deviations. See docs/measured.md."""

_SMALL: Final = (40, 24)
"""Size in which images are compared, px: details do not count."""


def alternating_cameras(images: Sequence[CameraFrame]) -> Recognition | None:
    """What to tell of images in a row, every second or third of which are alike, and neighbours are not: those of
    several cameras."""
    small = [cv2.resize(decode_grey_reduced(one.image, LIMITS), _SMALL, interpolation=cv2.INTER_AREA) for one in images]
    grey = np.array(small, np.float64).reshape(len(small), -1)
    grey = (grey - grey.mean(axis=1, keepdims=True)) / np.maximum(grey.std(axis=1, keepdims=True), 1.0)
    if len(grey) < COMPARED_IMAGES:
        return None
    one, two, three = (float(np.median(np.abs(grey[lag:] - grey[:-lag]).mean(axis=1))) for lag in (1, 2, 3))
    if one < UNLIKE or min(two, three) > ALTERNATING * one:
        return None
    count = 2 if two <= three else 3
    text = (
        f"The images alternate between {count} scenes: probably {count} cameras publish on the topic. Give each a "
        "topic of its own, and record again."
    )
    return Recognition("several_cameras", text, "fail")


def motions_of_one_frame(
    reader: BagReader, places: Sequence[MessageLocation], topic: str, requested: str | None
) -> list[MessageLocation]:
    """The messages of motion that are expressed in one frame: the one that was asked for, if there are several.

    Raises:
        SourceError: some of them name several frames, and none of these was asked for.
    """

    def frame_of(place: MessageLocation) -> str | None:
        if place.type_name != messages.ODOMETRY:
            return bare(place.frame_id)
        posed = _posed(reader, place)
        return None if posed is None else bare(posed.motion.frame_id)

    sampled = [index for start in evenly_spread(len(places), SAMPLED_MOVES) for index in (start, start + 1)]
    named = (frame_of(places[index]) for index in sampled if index < len(places))
    counts = Counter(frame for frame in named if frame is not None)
    # As in `BagIndex.require_one_frame`.
    counts = Counter({frame: count for frame, count in counts.items() if count > 1 or counts.total() < FEW})
    if len(counts) < 2:
        return list(places)
    if requested is None or bare(requested) not in counts:
        listed = ", ".join(map(ascii, sorted(counts)))
        raise SourceError(
            f"the messages on {topic} are of the motion of {len(counts)} frames: {listed}. Two programs publish on it: "
            "choose one with ?odometry_frame=NAME"
        )
    return [place for place in places if frame_of(place) == bare(requested)]


def motion_of_odometry(
    reader: BagReader, places: Sequence[MessageLocation], motion: str | None
) -> tuple[tuple[EgoMotion, ...] | None, Recognition | None]:
    """The motion by the poses of an odometry, if its velocities are not meant as stated or `motion` is `pose`; None:
    by its velocities. And what to tell.
    """
    if motion == "twist":
        return None, None
    if motion == "pose":
        return _by_poses(reader, places), None
    sampled = [one for index in _near_each_other(places) if (one := _posed(reader, places[index])) is not None]
    reading = message_evidence.reading_of_twists(sampled)
    if reading is message_evidence.TwistReading.AS_STATED:
        return None, None
    if reading is message_evidence.TwistReading.CONTRADICTED:
        text = (
            "The velocities of the odometry do not fit its poses; the velocities are used. If the poses are right, say "
            "?motion=pose; ?motion=twist leaves out this line."
        )
        return None, Recognition(TWIST_CONTRADICTED, text, "warn")
    text = (
        f"The velocities of the odometry are {reading}, by its poses: the motion is taken from the differences of the "
        "poses. If the velocities are right, say ?motion=twist."
    )
    return _by_poses(reader, places), Recognition("twist_from_poses", text)


def _by_poses(reader: BagReader, places: Sequence[MessageLocation]) -> tuple[EgoMotion, ...]:
    """The motion by the poses, without jumps that no vehicle makes."""
    posed = [one for place in places if (one := _posed(reader, place)) is not None]
    motions = message_evidence.motions_of_poses(posed)
    return tuple(
        motion for motion in motions if max(map(abs, (*(motion.linear_mps or ()), *motion.angular_radps))) <= MAX_SPEED
    )


def _near_each_other(places: Sequence[MessageLocation]) -> list[int]:
    """Indices of some messages, and of those that follow each until poses are far enough apart."""
    selected: set[int] = set()
    for start in evenly_spread(len(places), SAMPLED_MOVES):
        for index in range(start, min(start + MOST_BETWEEN, len(places))):
            selected.add(index)
            if places[index].stamp_ns - places[start].stamp_ns >= message_evidence.LEAST_S * 1e9:
                break
    return sorted(selected)


def _posed(reader: BagReader, place: MessageLocation) -> message_evidence.PoseAndTwist | None:
    """Pose and velocity of a message; None if it is damaged, which is told when it is used."""
    payload = reader(place.at)
    try:
        return message_evidence.PoseAndTwist(odometry_pose(payload), message_decoding.odometry(payload))
    except DecodeError:
        return None


@dataclass(frozen=True, slots=True, order=True)
class Sweep(MessageLocation):
    """A sweep: its cloud, or the clouds of which it consists, in the order of their stamps. Its stamp is that of the
    middle one."""

    clouds: tuple[MessageLocation, ...] = field(default=(), compare=False)


def sweeps_of_clouds(
    places: Sequence[MessageLocation], load: Callable[[MessageLocation], Iterator[LidarFrame]], clouds: int | None
) -> tuple[list[Sweep], tuple[Recognition, ...]]:
    """The sweeps that clouds make up, each alone or some of them a turn; and what to tell.

    Args:
        places: of the clouds, in the order of their stamps.
        load: a cloud; nothing if it is damaged.
        clouds: how many clouds make up a sweep; None: it is recognised.
    """
    alone = [Sweep(place.stamp_ns, place.at, place.type_name, clouds=(place,)) for place in places]
    if clouds is not None:
        return (alone if clouds == 1 else _joined(places, clouds)), ()
    seen = [cloud for place in places[:FEW_CLOUDS] for cloud in load(place)]
    if _overlap(seen):
        text = (
            "The clouds of the topic overlap in time: perhaps two LiDARs publish on it, and each needs its own; "
            "?clouds_per_sweep=1 leaves out this line."
        )
        return alone, (Recognition("several_lidars", text, "warn"),)
    # A LiDAR that does not turn shows the same sectors at once.
    if (
        not seen
        or message_evidence.sectors(seen[0]).sum() >= message_evidence.WHOLE * message_evidence.SECTORS
        or not _turning(seen)
    ):
        return alone, ()
    seen += [cloud for place in places[FEW_CLOUDS : message_evidence.MOST_CLOUDS] for cloud in load(place)]
    in_turn = message_evidence.clouds_in_turn([message_evidence.sectors(one) for one in seen])
    if in_turn == 1:
        return alone, ()
    degrees = 360 * float(np.median([message_evidence.sectors(one).sum() for one in seen])) / message_evidence.SECTORS
    what = f"Each cloud covers {degrees:.0f} degrees of the turn, {in_turn} in a row the whole"
    if in_turn == 2 and seen[0].time_offset_s is None:
        text = (
            f"{what}: perhaps two LiDARs publish on the topic, and each needs its own; if the clouds are parts of one "
            f"turn, say ?clouds_per_sweep={in_turn}, if not, ?clouds_per_sweep=1."
        )
        return alone, (Recognition("several_lidars", text, "warn"),)
    text = (
        f"{what}: {in_turn} clouds are joined to a sweep. Let the driver send whole turns (Velodyne: npackets, rpm, "
        "cut_angle), which the service needs; ?clouds_per_sweep=1 takes each cloud as a sweep."
    )
    return _joined(places, in_turn), (Recognition("partial_clouds", text, "warn"),)


def _overlap(clouds: Sequence[LidarFrame]) -> bool:
    """Whether consecutive clouds were measured at the same time: with one stamp, and not twice the same, or as far as
    points have times."""
    if any(a.stamp_ns == b.stamp_ns and not np.array_equal(a.xyz_m, b.xyz_m) for a, b in pairwise(clouds)):
        return True
    timed = [float(np.ptp(cloud.time_offset_s)) for cloud in clouds if cloud.time_offset_s is not None]
    stamps_ns = sorted({cloud.stamp_ns for cloud in clouds})
    if not timed or len(stamps_ns) < FEW_CLOUDS:
        return False
    intervals_s, lasts_s = 1e-9 * np.diff(stamps_ns), float(np.median(timed))
    # Of a recording with gaps, those between the clouds of one instant count.
    in_gaps = float((SHORTER * intervals_s < lasts_s).mean())
    return lasts_s > OVERLAPPING * float(np.median(intervals_s)) or in_gaps >= OVERLAPPING_SHARE


def _turning(seen: Sequence[LidarFrame]) -> bool:
    """Whether clouds look into different directions."""
    covered = [message_evidence.sectors(one) for one in seen]
    return bool(np.any(covered, axis=0).sum() > message_evidence.SAME * np.median([one.sum() for one in covered]))


def _joined(places: Sequence[MessageLocation], count: int) -> list[Sweep]:
    """Each `count` clouds in a row; those before a gap, or at the end, that make up no turn are left out."""
    gaps_ns = [later.stamp_ns - earlier.stamp_ns for earlier, later in pairwise(places)]
    longest_ns = GAP * float(np.median(gaps_ns)) if gaps_ns else 0.0
    sweeps: list[Sweep] = []
    row: list[MessageLocation] = []
    for place in places:
        if row and place.stamp_ns - row[-1].stamp_ns > longest_ns:
            row = []
        row.append(place)
        if len(row) == count:
            middle = row[count // 2]
            sweeps.append(Sweep(middle.stamp_ns, middle.at, middle.type_name, clouds=tuple(row)))
            row = []
    return sweeps


def joined(clouds: Sequence[LidarFrame], stamp_ns: int) -> LidarFrame:
    """One sweep of the points of some clouds, with this stamp. The points of a cloud without times have that of its
    stamp."""
    first, *others = clouds
    if not others:
        return first

    def column(name: str) -> NDArray[Any] | None:
        values = [getattr(cloud, name) for cloud in clouds]
        return None if any(of_cloud is None for of_cloud in values) else np.concatenate(values)

    times_s = [
        (np.zeros(len(cloud.xyz_m)) if cloud.time_offset_s is None else cloud.time_offset_s)
        + (cloud.stamp_ns - stamp_ns) * 1e-9
        for cloud in clouds
    ]
    return replace(
        first,
        stamp_ns=stamp_ns,
        xyz_m=np.concatenate([cloud.xyz_m for cloud in clouds]),
        intensity=column("intensity"),
        ring=column("ring"),
        time_offset_s=np.concatenate(times_s).astype(np.float32),
        not_finite=sum(cloud.not_finite for cloud in clouds),
        sequence=None,
    )


def compensated(
    sweeps: Iterable[LidarFrame], motions: Sequence[EgoMotion], T_lidar_ego: Matrix4, override: str = "?compensated=no"
) -> tuple[str | None, Recognition | None]:
    """The instant for which the points of these sweeps were compensated before they were recorded, as a name in
    `evidence.instants_s`, None: for none; and what to tell."""
    moving = []
    for sweep in sweeps:
        motion = motion_at(motions, sweep.stamp_ns, MOTION_REACH_NS // 5)
        if motion is not None and motion.reaches(evidence.LEAST_SPEED_MPS):
            moving.append((sweep, motion))
    instant = evidence.compensated_for(moving, T_lidar_ego)
    if instant is None:
        return None, None
    text = (
        f"The points were compensated for motion before they were recorded, for the {instant} of each sweep, because "
        f"undoing that makes their turn even: they are not compensated again. If that is wrong, say {override}."
    )
    return instant, Recognition("already_compensated", text)


def as_compensated(sweep: LidarFrame, instant: str) -> LidarFrame:
    """The sweep, all its points at the instant for which they were compensated."""
    at_s = evidence.instants_s(sweep).get(instant)
    if at_s is None:
        return sweep
    return replace(sweep, time_offset_s=np.full(len(sweep.xyz_m), at_s, np.float32))


# --- the rig ----------------------------------------------------------------------------------------------------------


class IntrinsicsFile(ConfigModel):
    """`intrinsics=FILE`: the head of a `dataset.yaml`, for bags without camera info or without a transform."""

    camera: CameraIntrinsics
    T_camera_lidar: Matrix4x4 | None = None
    mask: FilePath | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_direction(cls, document: Any) -> Any:
        return with_direction(document)


@dataclass(frozen=True, slots=True)
class PairMessages:
    """The first messages of a pair, and what was asked for: `intrinsics` a topic or file, `camera_frame` the frame of
    the images.

    Attributes:
        cloud: a sweep in the LiDAR's frame.
    """

    image_topic: str
    image: CameraFrame
    cloud: LidarFrame
    motion: EgoMotion | None
    intrinsics: str | None = None
    camera_frame: str | None = None


@dataclass(frozen=True, slots=True)
class _Lens:
    """Intrinsics and what comes with them; `frame_id` of the CameraInfo, empty if they come from elsewhere."""

    camera: Any
    frame_id: str = ""
    T_camera_lidar: Matrix4 | None = None
    mask: Any = None
    recognitions: tuple[Recognition, ...] = ()


def rig_of_bag(index: BagIndex, pair: PairMessages) -> tuple[Rig, tuple[Recognition, ...]]:
    """The rig of a pair, and what was recognised. Intrinsics come from the `CameraInfo` of the topic `intrinsics`, else
    beside the images, else of the camera's frame; or from the file `intrinsics`. The extrinsic comes from that file,
    else from the transforms.

    Raises:
        SourceError: there are no intrinsics, several, or those of another image size; or there is no extrinsic.
    """
    image, lidar_frame = pair.image, pair.cloud.frame_id
    try:
        lens = _lens_of(index, pair)
    except ValidationError as error:
        raise SourceError(f"{pair.intrinsics}: {describe(error)}") from error
    except (ConfigError, ValueError) as error:
        raise SourceError(f"intrinsics of {index.path}: {error}") from error
    if (image.image.width, image.image.height) != (lens.camera.width, lens.camera.height):
        raise SourceError(
            f"{index.path}: images are {image.image.width} x {image.image.height} px, "
            f"the intrinsics are for {lens.camera.width} x {lens.camera.height} px"
        )
    T_camera_lidar, recognised = lens.T_camera_lidar, lens.recognitions
    if T_camera_lidar is None:
        T_camera_lidar, of_frames = _extrinsic(index, pair, lens)
        recognised = (*recognised, *of_frames)
    if index.transforms.refused:
        text = f"Invalid transforms on /tf_static are left out: {left_out_text(index)}."
        recognised = (*recognised, Recognition("transforms_left_out", text, "warn"))
    T_lidar_ego = index.transform(lidar_frame, pair.motion.frame_id) if pair.motion else None
    rig = Rig(
        pair=re.sub(r"[^A-Za-z0-9_.-]", "_", index.path.stem)[:64],
        camera=lens.camera,
        camera_frame=image.frame_id,
        lidar_frame=lidar_frame,
        T_camera_lidar_nominal=T_camera_lidar,
        T_lidar_ego=np.eye(4) if T_lidar_ego is None else T_lidar_ego,
        mask=lens.mask,
    )
    return rig, recognised


def _extrinsic(index: BagIndex, pair: PairMessages, lens: _Lens) -> tuple[Matrix4, tuple[Recognition, ...]]:
    """T_camera_lidar (4, 4) along the transforms. The camera's frame is the one that was asked for, else that of the
    images; that of the CameraInfo instead, if only the latter is in the tree, or only with it points are in view (a
    driver that names the camera's body in its images)."""
    lidar_frame = pair.cloud.frame_id
    named, recognised = known_frame(index, pair.camera_frame or pair.image.frame_id)
    T = index.transform(named, lidar_frame)
    optical = bare(lens.frame_id)
    T_optical = None
    if pair.camera_frame is None and optical and optical != bare(named):
        T_optical = index.transform(optical, lidar_frame)
    if T is None and T_optical is None:
        raise SourceError(f"{index.path}: {unconnected_text(index, named, lidar_frame)}")
    in_view = [None if pose is None else share_in_image(lens.camera, pose, pair.cloud.xyz_m) for pose in (T_optical, T)]
    if T is None or message_evidence.sees_alone(*in_view):
        assert T_optical is not None
        why = "the transforms do not lead there" if T is None else "no points lie in the image there"
        text = (
            f"The camera's frame is {optical!a}, that of the CameraInfo: the images name {pair.image.frame_id!a}, but "
            f"{why}. ?camera_frame=NAME says otherwise."
        )
        recognised, named, T = (Recognition("camera_frame", text, "warn"),), optical, T_optical
    elif optical and pair.intrinsics is None and _is_elsewhere(index, optical, named):
        text = (
            f"The CameraInfo names the frame {optical!a}, the images {pair.image.frame_id!a}: it may be that of "
            "another camera. ?intrinsics=/TOPIC or FILE states the right one."
        )
        recognised = (*recognised, Recognition("camera_info_frame", text, "warn"))
    changes = index.transforms.changes(named, lidar_frame)
    if changes:
        text = f"/tf_static: {'; '.join(changes)}. ?intrinsics=FILE with `T_camera_lidar:` gives another."
        recognised = (*recognised, Recognition("transform_changes", text, "warn"))
    return T, recognised


SAME_PLACE_M: Final = 0.1
"""Frames of one camera, its body and its lens, are at most so far from each other."""


def _is_elsewhere(index: BagIndex, optical: str, named: str) -> bool:
    """Whether two frames are not those of one camera, by their names and transforms."""
    if bare(optical) == bare(named) or index.transforms.known(optical) == index.transforms.known(named):
        return False
    T = index.transform(named, optical)
    return T is None or float(np.linalg.norm(T[:3, 3])) > SAME_PLACE_M


def known_frame(index: BagIndex, frame_id: str) -> tuple[str, tuple[Recognition, ...]]:
    """The frame of this name among the transforms, see `StaticTransforms.known`, and what to tell of it."""
    known = index.transforms.known(frame_id)
    if known == bare(frame_id):
        return known, ()
    text = f"The frame {bare(frame_id)!a} of the messages is taken for {known!a} of the transforms."
    return known, (Recognition("frame_namespace", text, "warn"),)


def lidar_frame_of(index: BagIndex, cloud: LidarFrame, requested: str | None) -> tuple[str, Matrix4]:
    """The LiDAR's frame, and its pose (4, 4) in the frame in which a cloud is given. A name that was asked for stands
    for a frame of the cloud that the transforms do not know.

    Raises:
        SourceError: the transforms do not connect the two.
    """
    cloud_frame, _ = known_frame(index, cloud.frame_id)
    lidar_frame = cloud_frame if requested is None else requested
    T_cloud_lidar = index.transform(cloud_frame, lidar_frame)
    if T_cloud_lidar is None and bare(cloud_frame) in index.transforms.frames:
        raise SourceError(f"{index.path}: /tf_static does not connect {cloud_frame!r} and {lidar_frame!r}")
    return lidar_frame, np.eye(4) if T_cloud_lidar is None else T_cloud_lidar


def unconnected_text(index: BagIndex, target: str, source: str) -> str:
    """Why no transforms lead from one frame to the other, and what to do."""
    frames = index.transforms.frames
    listed = ", ".join(ascii(frame) for frame in frames[:LISTED]) + (", ..." if len(frames) > LISTED else "")
    left_out = left_out_text(index)
    return (
        f"/tf_static does not connect {target!r} and {source!r}; "
        "give ?intrinsics=FILE with `camera:` (which may name a camera_info.yaml) and `T_camera_lidar:` as in a "
        f"dataset.yaml, or name the frames with ?camera_frame= and ?lidar_frame=; there: {listed or 'none'}"
        + (f"; left out: {left_out}" if left_out else "")
        + (f"; {index.damaged.text}" if index.damaged else "")
        + part_of_bag_text(index.path)
    )


def part_of_bag_text(path: Path) -> str:
    """What to open instead of one file of a split bag; empty for another file."""
    is_part = path.is_file() and (path.parent / METADATA).is_file()
    return f"; it is one file of the bag {path.parent}: open that" if is_part else ""


def left_out_text(index: BagIndex) -> str:
    """The invalid transforms of `/tf_static`, with their causes."""
    refused = index.transforms.refused
    return "; ".join(f"{parent!a} -> {child!a}: {error}" for (parent, child), error in refused.items())


def _lens_of(index: BagIndex, pair: PairMessages) -> _Lens:
    rectified = camera_info.is_rectified(pair.image_topic)
    if pair.intrinsics is None or pair.intrinsics in index.infos:
        try:
            info, recognised = _info(index, pair)
            lens = camera_info.intrinsics_of_info(info, rectified=rectified)
        except SourceError as error:
            part = part_of_bag_text(index.path) + (f"; {index.damaged.text}" if index.damaged else "")
            raise SourceError(f"the camera info of {index.path}: {error}; give ?intrinsics=FILE{part}") from error
        if lens.is_adapted:
            text = f"The lens is that of {lens.source}; give ?intrinsics=FILE if the images are not so."
            recognised = (*recognised, Recognition("camera_info_adapted", text))
        return _Lens(camera_of(lens.intrinsics), info.frame_id, recognitions=recognised)
    path = expand_home(pair.intrinsics)
    content, name = load_camera_document(path)
    size = (pair.image.image.width, pair.image.image.height)
    described = with_camera(content, path, name, rectified=rectified, size=size)
    if not isinstance(described, dict) or "camera" not in described:
        raise SourceError(
            f"{path} describes no camera that is known: it may be a CameraInfo of ROS in YAML, a camera chain of "
            "Kalibr, a calibration of Basalt, matrices of OpenCV, the JSON of Apollo or SensorsCalibration, or have "
            "`camera:` as a dataset.yaml has"
        )
    document = IntrinsicsFile.model_validate(described)
    camera = camera_of(document.camera)
    T, mask = document.T_camera_lidar, document.mask
    return _Lens(
        camera,
        T_camera_lidar=None if T is None else rigid_matrix(T, "T_camera_lidar"),
        mask=None if mask is None else load_mask(path.parent / mask, camera),
    )


def _info(index: BagIndex, pair: PairMessages) -> tuple[camera_info.CameraInfoContent, tuple[Recognition, ...]]:
    """The camera info that was asked for, else the one beside the images, of the camera's frame, or the only one."""
    frames = (pair.image.frame_id, bare(pair.image.frame_id))
    topic = pair.intrinsics or camera_info.info_topic(pair.image_topic)
    if topic in index.infos:
        return index.infos[topic].content(frames)
    matching = [infos for infos in index.infos.values() if not infos.frames().isdisjoint(frames)]
    candidates: Sequence[camera_info.CameraInfos] = matching or list(index.infos.values())
    if len(candidates) != 1:
        topics = ", ".join(index.infos) or "none"
        raise SourceError(f"{len(candidates)} camera infos fit; name one with ?intrinsics=/TOPIC; there: {topics}")
    return candidates[0].content(frames)
